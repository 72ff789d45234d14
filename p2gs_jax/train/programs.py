"""Compiled steps: one per image size and run, compiled ahead of their turn in the background.

XLA holds no lock of Python's while it compiles, so the program of the next level is made while the
present one runs. Seconds that a run waits for the compiler are counted, and never as pace.
"""

from __future__ import annotations

import time
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple

import jax

from p2gs_jax.render.capacity import Room


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
        step: from `make_step`.

    Attributes:
        waited_s: seconds for which a program was waited for.
    """

    def __init__(self, step):
        self._step = step
        self._made: dict[Key, Future] = {}
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="compile")
        self.waited_s = 0.0

    def expect(self, key: Key, *arguments: Any) -> None:
        """Begin to compile a step in the background.

        Args:
            key: what for.
            arguments: of the step, or their shapes.
        """
        if key not in self._made:
            static = {"room": key.room, "degree": key.degree}
            self._made[key] = self._submit(self._step, arguments, static)

    def ahead(self, program, *arguments: Any):
        """Begin to compile another program in the background, and return it.

        Args:
            program: a jitted function, called with arguments of these shapes from here on.
            arguments: its arguments, or their shapes.
        """
        future = self._submit(program, arguments, {})
        return lambda *given: self._wait(future)(*given)

    def _submit(self, program, arguments, static: dict[str, Any]) -> Future:
        shapes = jax.tree.map(
            lambda a: jax.ShapeDtypeStruct(a.shape, a.dtype, weak_type=False), arguments
        )
        return self._worker.submit(lambda: program.lower(*shapes, **static).compile())

    def get(self, key: Key, *arguments: Any):
        """Return a compiled step, `(state, batch, partner, controls) -> (state, report)`."""
        self.expect(key, *arguments)
        return self._wait(self._made[key])

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
