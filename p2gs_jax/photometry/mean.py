"""What a view that has no parameters of its own is shown with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import numpy as np

from p2gs_jax.config import PhotometryConfig
from p2gs_jax.photometry.appearance import mean_correction
from p2gs_jax.photometry.cameras import camera_row
from p2gs_jax.photometry.display import DisplayTransform
from p2gs_jax.types import Params, Photometry


@dataclass(frozen=True)
class MeanParameters:
    """Parameters of a view that has none of its own.

    Attributes:
        exposure: arithmetic mean over the training views (paper, eq. 6).
        exposure_geometric: geometric mean, which the gauges leave in place.
        gamma: arithmetic mean.
        white_balance: mean of the log factors, or None where white balance is not modelled.
    """

    exposure: float
    exposure_geometric: float
    gamma: float
    white_balance: tuple[float, float, float] | None = None


def mean_parameters(photometry: Photometry) -> MeanParameters:
    """Return the means over the training views."""
    taken: Photometry = jax.tree.map(np.asarray, photometry)
    e = taken.exposures.astype(np.float64)
    return MeanParameters(
        float(e.mean()),
        float(np.exp(np.log(e).mean())),
        float(taken.gammas.astype(np.float64).mean()),
        _mean_balance(taken, slice(None)),
    )


def usual_display(
    params: Params, taken_by: Sequence[str], camera: str | None, cfg: PhotometryConfig
) -> DisplayTransform:
    """Return how a view is shown that has no parameters of its own.

    Its exposure is the geometric mean over the training views, its gamma and its correction are the
    mean ones. Its white balance is the mean over all training views, or over those of its camera
    where it varies by camera only. Its vignetting and its response are its
    camera's, those of a correction as well.

    Args:
        params: the fit.
        taken_by: the camera of every training view.
        camera: which took the view; None: none of them, as for free views.
        cfg: the formation model.
    """
    taken: Photometry = jax.tree.map(np.asarray, params.photometry)
    mean = mean_parameters(taken)
    balance = mean.white_balance
    own = np.array([name == camera for name in taken_by], bool)
    if cfg.white_balance == "camera" and own.any():
        balance = _mean_balance(taken, own)
    return DisplayTransform(
        mean.exposure_geometric,
        mean.gamma,
        cfg,
        mean_correction(params.appearance, camera),
        balance,
        None if camera is None else camera_row(camera, cfg),
    )


def _mean_balance(photometry: Photometry, rows) -> tuple[float, float, float] | None:
    balance = photometry.white_balance
    if balance is None:
        return None
    red, green, blue = (float(v) for v in np.asarray(balance, np.float64)[rows].mean(0))
    return red, green, blue
