"""Which program a step needs at its level, and which to compile ahead."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from p2gs_jax.config import FitConfig
from p2gs_jax.train import schedule
from p2gs_jax.train.data_parallel import ParallelStep
from p2gs_jax.train.host import HostState
from p2gs_jax.train.inputs import Inputs
from p2gs_jax.train.programs import Key, StepPrograms
from p2gs_jax.train.room import cameras_by_size, size_name
from p2gs_jax.train.schedule import Levels
from p2gs_jax.train.state import FitState
from p2gs_jax.train.step import Step
from p2gs_jax.train.views import TrainingViews


class LevelPrograms:
    """The programs of a fit's steps, by level of the schedule.

    Args:
        cfg: everything.
        step: of the fit.
        programs: compiled steps, some of them perhaps begun.
        levels: of the schedule.
    """

    def __init__(
        self, cfg: FitConfig, step: Step | ParallelStep, programs: StepPrograms, levels: Levels
    ):
        self.cfg, self.step, self.programs, self.levels = cfg, step, programs, levels

    def get(self, state: FitState, inputs: Inputs, host: HostState) -> Callable[..., Any]:
        """Return the compiled step, waiting for it if need be.

        Args:
            state: for its slots.
            inputs: of the step, or of another of this size.
            host: for the rooms, and the level.
        """
        key = self._key(state, inputs, host, host.shrink)
        return self.programs.get(self.step, key, state, *inputs)

    def ahead(self, progress: float, views: TrainingViews) -> list[int]:
        """Return the levels to compile ahead, as factors by which images are shrunk.

        Those with images of several sizes are left out: it is not known which comes first.
        """
        left = schedule.shrinks_left(progress, self.levels)
        return [shrink for shrink in left if len(cameras_by_size(views, shrink)) == 1]

    def expect(
        self, state: FitState, inputs: Inputs, host: HostState, shrink: int, images: bool
    ) -> None:
        """Begin to compile the step of a level in the background.

        Args:
            state: for its slots, which stay as they are; or its shapes.
            inputs: of any step of the level.
            host: for the rooms.
            shrink: factor by which the images of the level are shrunk.
            images: what composites images as well, which knows the tone curve.
        """
        key = self._key(state, inputs, host, shrink)
        self.programs.expect(self.step, key, state, *inputs, images=images)

    def _key(self, state: FitState, inputs: Inputs, host: HostState, shrink: int) -> Key:
        room = host.rooms[size_name(inputs.size)]
        slots = state.params.gaussians.capacity
        return Key(inputs.size, slots, room, self._degree(shrink), str(inputs.batch.ldr.dtype))

    def _degree(self, shrink: int) -> int:
        """Return the highest spherical-harmonics degree that a level uses."""
        end = next((end for end, factor in self.levels if factor == shrink), 1.0)
        return schedule.sh_degree_at(end, self.cfg.train, self.cfg.render.sh_degree)
