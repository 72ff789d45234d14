"""Compiled steps, compiled ahead of their turn in the background.

XLA holds no lock of Python's while it compiles, so the program of the next level is made while the
present one runs. Seconds that a run waits for the compiler are counted, and never as pace.
"""

from __future__ import annotations

import functools
import os
import time
from collections.abc import Callable, Hashable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple

import jax

from p2gs_jax.render.capacity import Room
from p2gs_jax.train.data_parallel import ParallelStep
from p2gs_jax.train.step import Step

# The first step waits for two programs of about equal size; but XLA itself compiles on several
# cores, and two at once on two cores take three times as long each (ours: BUILD_NOTES).
WORKERS = 1 if (os.cpu_count() or 1) <= 2 else 2


class Key(NamedTuple):
    """What a step is compiled for.

    Attributes:
        size: image width and height, pixels.
        slots: room of the population.
        room: of a view.
        degree: highest spherical-harmonics degree in use.
        pixels: type of the photograph as it is stored.
    """

    size: tuple[int, int]
    slots: int
    room: Room
    degree: int
    pixels: str


class StepPrograms:
    """The compiled steps of a fit.

    Levels and populations share those of the three programs of a step that they can, and so do a
    step that was made before the exposures were known and the one that was made after.

    Attributes:
        rooms: of the image sizes, by name, for which programs were begun before the start.
        waited_s: seconds for which a program was waited for.
    """

    def __init__(self):
        self.rooms: dict[str, Room] = {}
        self._made: dict[Hashable, Future] = {}
        self._ready: dict[tuple[Step | ParallelStep, Key], Callable] = {}
        self._worker = ThreadPoolExecutor(WORKERS, thread_name_prefix="compile")
        self.waited_s = 0.0

    def expect(
        self, step: Step | ParallelStep, key: Key, *arguments: Any, images: bool = True
    ) -> None:
        """Begin to compile a step in the background.

        Args:
            step: of the fit.
            key: what for.
            arguments: of the step, or their shapes.
            images: the program between as well, which knows the tone curve.
        """
        self._parts(step, key, arguments, images)

    def _parts(
        self, step: Step | ParallelStep, key: Key, arguments, images: bool = True
    ) -> list[Future]:
        """Return the programs of a step in their order, those yet unknown on their way."""
        visible_only = step.settings("show")["visible_only"]
        rows = min(key.room.visible, key.slots) if visible_only else key.slots
        of_gaussians = (key.slots, rows, key.degree)
        shapes = {
            "show": of_gaussians,
            "differentiate": (key.size, key.room.entries, rows, key.pixels),
            "advance": of_gaussians,
        }
        keys = {
            name: (name, tuple(step.settings(name).values()), shape)
            for name, shape in shapes.items()
        }
        # The longest first.
        wanted = ("differentiate", "show", "advance") if images else ("advance", "show")
        for name in wanted:
            if keys[name] not in self._made:
                lowered = functools.partial(step.lowered, name, *_shapes(arguments))
                self._made[keys[name]] = self._worker.submit(
                    lambda lowered=lowered: lowered(room=key.room, degree=key.degree).compile()
                )
        return [self._made[keys[name]] for name in shapes if name in wanted]

    def ahead(self, key: Hashable, program, *arguments: Any, **static: Any) -> Callable:
        """Begin to compile another program in the background, and return it.

        Args:
            key: tells it from others.
            program: a jitted function.
            arguments: its arguments, or their shapes.
            static: its static arguments, which the returned function is called without.
        """
        if key not in self._made:
            self._made[key] = self._worker.submit(
                lambda: program.lower(*_shapes(arguments), **static).compile()
            )
        future = self._made[key]
        return lambda *given: self._wait(future)(*given)

    def get(self, step: Step | ParallelStep, key: Key, *arguments: Any):
        """Return a compiled step, `(state, batch, partner, controls) -> (state, report)`."""
        if (step, key) not in self._ready:
            parts = self._parts(step, key, arguments)
            self._ready[step, key] = step.chained(*(self._wait(part) for part in parts))
        return self._ready[step, key]

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
