"""The viewer's settings, and the display transform that they give."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from p2gs_jax.photometry.display import DisplayTransform
from p2gs_jax.run.read import Run
from p2gs_jax.viewer.picture_modes import Mode

ChosenCurve = Literal["run", "srgb", "power", "linear"]


@dataclass(frozen=True)
class Settings:
    """The display transform and the mode.

    Attributes:
        gamma: > 0.
        exposure_ev: stops from the geometric mean of the training exposures, or from the metered
            exposure.
        curve: `run` is what the fit chose.
        taken_as: row in `scene.views` of the view whose correction applies, or None for the mean.
        mode: what is shown.
        split: share of the photograph in `split`.
        splats: whether the browser draws splats itself, instead of the renderer's pictures.
        metered: whether the exposure follows what is seen; not of the browser's splats.
    """

    gamma: float
    exposure_ev: float = 0.0
    curve: ChosenCurve = "run"
    taken_as: int | None = None
    mode: Mode = "display"
    split: float = 0.5
    splats: bool = False
    metered: bool = False


def common_settings(run: Run, before: Settings | None = None) -> Settings:
    """Return settings with the mean exposure and gamma.

    Args:
        run: the run.
        before: settings that all other fields are kept from.
    """
    gamma = run.mean.gamma
    if before is None:
        return Settings(gamma)
    return replace(before, gamma=gamma, exposure_ev=0.0, curve="run", taken_as=None, metered=False)


def settings_of_view(run: Run, index: int, before: Settings) -> Settings:
    """Return settings with the exposure, gamma and correction of a view.

    Args:
        run: the run.
        index: row in `scene.views`.
        before: settings that all other fields are kept from.
    """
    own = run.own_display(index)
    ev = float(np.log2(own.exposure / run.mean.exposure_geometric))
    return replace(
        before, gamma=own.gamma, exposure_ev=ev, curve="run", taken_as=index, metered=False
    )


def same_display(a: Settings, b: Settings) -> bool:
    """Return whether two settings have the same display transform, whatever their mode."""
    return replace(a, mode=b.mode, split=b.split, splats=b.splats) == b


def display_of(run: Run, settings: Settings) -> DisplayTransform:
    """Return the display transform of settings; corrections apply under the run's curve only."""
    transform = run.common_display(settings.exposure_ev)
    if settings.taken_as is not None:
        transform = replace(transform, correction=run.own_display(settings.taken_as).correction)
    transform = replace(transform, gamma=settings.gamma)
    return transform if settings.curve == "run" else transform.with_curve(settings.curve)


def exposures_ev(run: Run) -> dict[int, float]:
    """Return stops from the geometric mean of every training view, by row in `scene.views`."""
    values = np.log2(np.asarray(run.params.photometry.exposures, float))
    values = values - np.log2(run.mean.exposure_geometric)
    return dict(zip(run.scene.train_indices, values.tolist(), strict=True))
