"""Compiled steps, compiled ahead of their turn in the background.

XLA holds no lock of Python's while it compiles, so the program of the next level is made while the
present one runs. Seconds that a run waits for the compiler are counted, and never as pace.
"""

from __future__ import annotations

import functools
import time
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple

import jax

from p2gs_jax.render.capacity import Room
from p2gs_jax.train.step import Step

# The first step waits for two programs of about equal size.
WORKERS = 2


class Key(NamedTuple):
    """What a step is compiled for.

    Attributes:
        size: image width and height, pixels.
        slots: room of the population.
        room: of a view.
        degree: highest spherical-harmonics degree in use.
        pixels: types of the view's and the partner's photographs as they are stored.
    """

    size: tuple[int, int]
    slots: int
    room: Room
    degree: int
    pixels: tuple[str, ...]


class StepPrograms:
    """The compiled steps of a run.

    Args:
        step: from `make_step`; levels and populations share those of its programs that they can.

    Attributes:
        waited_s: seconds for which a program was waited for.
    """

    def __init__(self, step: Step):
        self._step = step
        self._made: dict[tuple, Future] = {}
        self._worker = ThreadPoolExecutor(WORKERS, thread_name_prefix="compile")
        self.waited_s = 0.0

    def expect(self, key: Key, *arguments: Any) -> None:
        """Begin to compile a step in the background.

        Args:
            key: what for.
            arguments: of the step, or their shapes.
        """
        self._parts(key, arguments)

    def _parts(self, key: Key, arguments) -> list[Future]:
        """Return the programs of a step in their order, those yet unknown on their way."""
        rows = min(key.room.visible, key.slots)
        of_gaussians = (key.slots, rows, key.degree)
        keys = [
            ("show", *of_gaussians),
            ("differentiate", key.size, key.room.entries, rows, key.pixels),
            ("advance", *of_gaussians),
        ]
        # The longest first.
        for name in (keys[1], keys[0], keys[2]):
            if name not in self._made:
                state, batch, partner, controls = _shapes(arguments)
                lowered = functools.partial(
                    self._step.lowered, name[0], state, batch, partner, controls
                )
                self._made[name] = self._worker.submit(
                    lambda lowered=lowered: lowered(room=key.room, degree=key.degree).compile()
                )
        return [self._made[name] for name in keys]

    def ahead(self, program, *arguments: Any):
        """Begin to compile another program in the background, and return it.

        Args:
            program: a jitted function, called with arguments of these shapes from here on.
            arguments: its arguments, or their shapes.
        """
        future = self._worker.submit(lambda: program.lower(*_shapes(arguments)).compile())
        return lambda *given: self._wait(future)(*given)

    def get(self, key: Key, *arguments: Any):
        """Return a compiled step, `(state, batch, partner, controls) -> (state, report)`."""
        return self._step.chained(*(self._wait(part) for part in self._parts(key, arguments)))

    def _wait(self, future: Future):
        if future.done():
            return future.result()
        begin = time.monotonic()
        try:
            return future.result()
        finally:
            self.waited_s += time.monotonic() - begin

    def close(self) -> None:
        """Forget programs whose compilation has not begun."""
        self._worker.shutdown(wait=False, cancel_futures=True)


def _shapes(arguments):
    return jax.tree.map(
        lambda a: jax.ShapeDtypeStruct(a.shape, a.dtype, weak_type=False), arguments
    )
