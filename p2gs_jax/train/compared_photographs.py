"""What the relative-exposure loss compares where it looks at photographs."""

from __future__ import annotations

import numpy as np

from p2gs_jax.config import FitConfig
from p2gs_jax.core.numerics import on_device
from p2gs_jax.errors import UserError
from p2gs_jax.losses.relative_exposure import ColorPairs
from p2gs_jax.photometry.formation import darkens
from p2gs_jax.photometry.observations import Observations, sample_pairs

PAIR_POOL = 200_000


def color_pairs(tracks: Observations | None, cfg: FitConfig) -> ColorPairs | None:
    """Return pairs of colours of one point in two views; None where the loss uses none.

    Args:
        tracks: colours of shared points, or None.
        cfg: the loss, and the seed.

    Raises:
        UserError: the loss wants them and the scene has no tracks.
    """
    relative = cfg.loss.relative_exposure
    if relative.weight is None or relative.form != "observed_ldr":
        return None
    if tracks is None or not len(tracks.points):
        raise UserError(
            "the relative-exposure loss was to compare photographs at tracks, and this scene has "
            "none.",
            fix="use --loss.relative-exposure.form literal_same_pose, or a scene with tracks",
        )
    first, second = sample_pairs(tracks, PAIR_POOL, cfg.train.seed)
    return ColorPairs(
        on_device(tracks.colors[first]),
        on_device(tracks.colors[second]),
        on_device(tracks.views[first], np.int32),
        on_device(tracks.views[second], np.int32),
        on_device(np.ones(len(first))),
        *_positions(tracks, (first, second), cfg),
    )


def _positions(tracks: Observations, picks, cfg: FitConfig):
    """Return where in their images observations lie; nothing where no camera has vignetting."""
    if not darkens(cfg.photometry):
        return ()
    if tracks.positions is None:
        raise ValueError("vignetting is modelled, and nobody knows where in the images points lie")
    return tuple(on_device(tracks.positions[pick]) for pick in picks)
