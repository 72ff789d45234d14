"""What a step is given beside its state: a photograph, a second view, the schedule."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from p2gs_jax.config import FitConfig
from p2gs_jax.core.numerics import on_host
from p2gs_jax.core.streams import device_seed
from p2gs_jax.losses.relative_exposure import ColorPairs
from p2gs_jax.losses.total import Partner
from p2gs_jax.train import schedule
from p2gs_jax.train.advance import Controls
from p2gs_jax.train.batches import stacked
from p2gs_jax.train.partner import partner_at
from p2gs_jax.train.views import TrainingViews
from p2gs_jax.types import Batch


class Inputs(NamedTuple):
    """Arguments of a step, all on the host.

    Attributes:
        batch: the view and its photograph; of several views, stacked.
        partner: what the relative-exposure loss compares it with.
        controls: of the schedule.
    """

    batch: Batch
    partner: Partner
    controls: Controls

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image, pixels."""
        return self.batch.camera.width, self.batch.camera.height


class InputSource:
    """The inputs of every step of a fit; they follow from the seed and the step number.

    Args:
        cfg: everything.
        views: the training views.
        pairs: corresponding observations, for the relative-exposure readings that need them.
        shown: share of the scene that a view shows.
    """

    def __init__(
        self,
        cfg: FitConfig,
        views: TrainingViews,
        pairs: ColorPairs | None,
        shown: float,
    ):
        self.cfg, self.views, self.pairs, self.shown = cfg, views, pairs, shown

    def at(self, step: int, progress: float, pace: float, shrink: int) -> Inputs:
        """Return the inputs of a step.

        Args:
            step: its number.
            progress: fraction of the run completed before it.
            pace: progress of one step.
            shrink: factor by which images are shrunk.
        """
        cfg = self.cfg
        degree = schedule.sh_degree_at(progress, cfg.train, cfg.render.sh_degree)
        rate = schedule.rate_factor(pace, self.shown, cfg.optimizer.settled)
        controls = on_host(
            Controls,
            np.float32(progress),
            np.int32(degree),
            np.float32(rate),
            device_seed(cfg.train.seed),
        )
        rows = self.views.indices_at(step, cfg.train.batch)
        each = [self._of_view(step + k, row, shrink) for k, row in enumerate(rows)]
        if len(each) == 1:
            return Inputs(*each[0], controls)
        batches, partners = zip(*each, strict=True)
        return Inputs(stacked(batches), stacked(partners), controls)

    def _of_view(self, step: int, row: int, shrink: int) -> tuple[Batch, Partner]:
        batch = self.views.batch(row, shrink, step)
        return batch, partner_at(step, row, shrink, self.views, self.pairs, self.cfg)

    def prefetch(self, step: int, shrink: int) -> None:
        """Begin decoding the photographs of a step in the background."""
        for row in self.views.indices_at(step, self.cfg.train.batch):
            self.views.prefetch(row, shrink)
