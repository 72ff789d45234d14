"""The settings of the viewer, and the display transform made from them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from p2gs_jax.photometry.display import DisplayTransform
from p2gs_jax.run.read import Run
from p2gs_jax.viewer.pictures import Mode

ChosenCurve = Literal["run", "srgb", "power", "linear"]


@dataclass(frozen=True)
class Settings:
    """The display transform and the mode.

    `view` is the row in `scene.views` of the view whose correction, vignetting and response apply.
    None: the mean correction and response apply, without vignetting.
    """

    gamma: float
    exposure_ev: float = 0.0  # stops from the geometric mean of the training exposures
    curve: ChosenCurve = "run"  # `run`: the curve of the fit
    view: int | None = None
    balance_ev: tuple[float, float] | None = None  # gains of red and blue over green, stops
    vignetting: bool = True  # whether the vignetting of the view's camera applies
    mode: Mode = "display"
    split: float = 0.5  # visible share of the photograph's width in the mode `split`


def common_settings(run: Run, before: Settings | None = None) -> Settings:
    """Return settings with the mean display of a run; mode, vignetting and split stay."""
    common = run.common_display()
    return _apply(before or Settings(common.gamma), common, 0.0, None)


def settings_of_view(run: Run, index: int, before: Settings) -> Settings:
    """Return settings with the display of a row of `scene.views`, as `common_settings` does."""
    display = run.own_display(index)
    ev = float(np.log2(display.exposure / run.mean.exposure_geometric))
    return _apply(before, display, ev, index)


def _apply(before: Settings, display: DisplayTransform, ev: float, view: int | None) -> Settings:
    balance = None if display.white_balance is None else display.white_balance_ev
    new = {"gamma": display.gamma, "exposure_ev": ev, "view": view, "balance_ev": balance}
    return replace(before, curve="run", **new)


def display_of(run: Run, settings: Settings) -> DisplayTransform:
    """Return the display transform of settings; a correction applies only to the run's curve."""
    transform = run.common_display(settings.exposure_ev)
    if settings.view is not None:
        display = run.own_display(settings.view)
        transform = replace(transform, correction=display.correction, camera=display.camera)
    transform = replace(transform, gamma=settings.gamma)
    if settings.balance_ev is not None and transform.white_balance is not None:
        transform = transform.with_white_balance_ev(*settings.balance_ev)
    if not settings.vignetting:
        transform = transform.without_place()
    return transform if settings.curve == "run" else transform.with_curve(settings.curve)


def exposures_ev(run: Run) -> dict[int, float]:
    """Return the training exposures by row in `scene.views`, stops from their geometric mean."""
    values = np.log2(np.asarray(run.params.photometry.exposures, float))
    values = values - np.log2(run.mean.exposure_geometric)
    return dict(zip(run.scene.train_indices, values.tolist(), strict=True))
