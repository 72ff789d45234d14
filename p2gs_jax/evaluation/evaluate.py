"""Evaluation of a finished fit: every view under every protocol.

Protocols (docs/photometry.md, 6):

- `per_view` renders a training view with its fitted exposure, gamma and white balance.
- `averaged` uses the mean parameters over the training views (paper, Rendering for evaluation).
- `exposure_fitted` solves one scalar exposure of a held-out view from its photograph.
- `photometry_fitted` solves all parameters that vary per view, if any besides exposure does.
- `metered` uses the metering rule that explains the training exposures, if there is one
  (photometry/metering.py).
- `scale_aligned` solves one scalar for all reference photographs of one common exposure.

Vignetting and response always come from the view's camera. If photographs have alpha, they and the
renders are over the same background (photometry/formation.py).
"""

from __future__ import annotations

import functools
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float32

from p2gs_jax.config import FitConfig
from p2gs_jax.core.threads import map_in_order
from p2gs_jax.evaluation import scores as scoring
from p2gs_jax.evaluation.alignment import fit_capture, with_fitted_exposure
from p2gs_jax.evaluation.drives import DepthScores
from p2gs_jax.evaluation.lpips import LpipsWeights
from p2gs_jax.evaluation.radiance import Alignment, Truth, sampled
from p2gs_jax.evaluation.references import Reference
from p2gs_jax.photometry import display
from p2gs_jax.photometry.formation import exposed_at
from p2gs_jax.photometry.metering import BELOW_WHITE, Metering, Readings, fit_metering, meter
from p2gs_jax.photometry.models import MODELS
from p2gs_jax.render.capacity import RenderView, make_renderer
from p2gs_jax.scene.pixels.store import ImageStore, camera_of
from p2gs_jax.types import Camera, Params, Render, Scene


class Evaluation(NamedTuple):
    """The result of an evaluation."""

    # the `train`, `test`, `consistency`, `reference` and `radiance` parts of `metrics.json`, the
    # parts of drives, and the views without scores or exposure
    metrics: dict[str, Any]
    metering: Metering  # the rule that explains the exposures of the training views


class Judge:
    """The inputs of scores: photographs, display transforms of a run, and kinds of scores.

    Display transforms follow from the photometry and the appearance of `params`. Without weights
    there is no LPIPS; `reference` is as for `evaluate`.
    """

    def __init__(
        self,
        scene: Scene,
        store: ImageStore,
        params: Params,
        cfg: FitConfig,
        lpips_weights: LpipsWeights | None = None,
        reference: Reference | None = None,
    ):
        self.scene, self.store, self.cfg = scene, store, cfg
        self.lpips_weights, self.reference = lpips_weights, reference
        # Small arrays stay on the host.
        without = eqx.tree_at(
            lambda p: p.gaussians, params, None, is_leaf=lambda leaf: leaf is None
        )
        self.small: Params = jax.tree.map(np.asarray, without)
        self.mean = display.mean_parameters(self.small.photometry)
        self.cameras = [view.camera for view in scene.training_views]
        self.row_of = {index: row for row, index in enumerate(scene.train_indices)}

    def usual(self, index: int | None) -> display.DisplayTransform:
        """Return the display transform of a view by mean parameters; None: without a camera."""
        camera = None if index is None else self.scene.views[index].camera
        shown = display.usual_display(self.small, self.cameras, camera, self.cfg.photometry)
        return self.over(shown)

    def over(self, transform: display.DisplayTransform) -> display.DisplayTransform:
        """Return a display transform with the background of the photographs."""
        return replace(transform, backdrop=self.store.backdrop_values)

    def scorer(self, index: int, photograph, mask) -> Callable[[np.ndarray], dict[str, Any]]:
        """Return a function from display images of a view to scores, in drives also by part."""
        parts = scoring.masks_of_parts(self.scene, index, mask)
        return lambda ldr: scoring.view_scores(self.lpips_weights, ldr, photograph, mask, parts)


def evaluate(
    params: Params,
    scene: Scene,
    store: ImageStore,
    cfg: FitConfig,
    *,
    render: RenderView | None = None,
    reference: Reference | None = None,
    radiance: Truth | None = None,
    lpips_weights: LpipsWeights | None = None,
    on_view: Callable[[scoring.ViewResult], None] = lambda result: None,
    on_progress: Callable[[int, int], None] = lambda done, count: None,
) -> Evaluation:
    """Render and score all views.

    `params` holds live Gaussians only; `render` is from `make_renderer`, with the owners of
    moving Gaussians. For the row of a view, `reference` returns the photograph under the common
    exposure, and `radiance` the true linear radiance at the size of the photographs, or None. With
    weights, every comparison with a photograph has `lpips`. `on_progress` receives the number of
    views done, and the number of all views. UserError: an image is too small for LPIPS.
    """
    judge = Judge(scene, store, params, cfg, lpips_weights, reference)
    gaussians = jax.device_put(params.gaussians)
    render = render or make_renderer(cfg.render)
    render_camera = functools.partial(render, gaussians, gaussians.all_alive)
    views = _Views(judge, render_camera, radiance)
    judged = functools.partial(_judged, judge, render_camera, radiance)
    # Views are in the order of names, in which the frames of a camera are in sequence.
    for found in map_in_order(judged, range(len(scene.views))):
        on_progress(found.result.index + 1, len(scene.views))
        views.add(found)
        on_view(found.result)
    return views.evaluation()


class _Judged(NamedTuple):
    """A view with its scores, and its data for scores that need all views."""

    result: scoring.ViewResult
    averaged: Float32[np.ndarray, "h w 3"]  # display values with the mean parameters
    mask: Float32[np.ndarray, "h w"]
    scores: dict[str, Any]  # scores of `result.ldr`
    scores_averaged: dict[str, Any]  # scores of `averaged`
    scores_all: dict[str, Any] | None  # scores of `photometry_fitted`, or None
    sample: np.ndarray | None  # sample of rendered and true radiance, or None
    scale: float | None  # exposure with which the render fits its reference, or None
    readings: Readings  # readings of meters, for exposures


def _judged(
    judge: Judge, render: Callable[[Camera], Render], radiance: Truth | None, index: int
) -> _Judged:
    """Render a view and score it under the protocols that need no other view."""
    scene, store = judge.scene, judge.store
    photograph, mask = store.get(index, 1)
    score = judge.scorer(index, photograph, mask)
    rendered = render(camera_of(store, index))
    linear, alpha = np.asarray(rendered.linear), np.asarray(rendered.alpha)
    usual = judge.usual(index)
    averaged = display.develop(linear, replace(usual, exposure=judge.mean.exposure), alpha=alpha)
    extra, scores_all = {}, None
    if scene.views[index].split == "train":
        fitted = display.display_of_view(judge.small, judge.row_of[index], judge.cfg.photometry)
        transform = judge.over(fitted)
    elif not mask.any():
        transform = usual
    else:
        still = scoring.still_mask(scene, index, mask)
        transform = with_fitted_exposure(usual, linear, photograph, still, alpha)
        extra = {"exposure": transform.exposure}
        scores_all = _all_fitted(linear, photograph, still, transform, score, alpha)
    ldr = display.develop(linear, transform, alpha=alpha)
    depth = np.asarray(rendered.depth)
    truth = None if radiance is None else radiance(index)
    target = None if judge.reference is None else judge.reference(index)
    scale = sample = None
    if target is not None:
        usual_of_all = judge.usual(None)
        scale = with_fitted_exposure(usual_of_all, linear, target, mask, alpha).exposure
    if truth is not None:
        sample = sampled(linear, truth, mask > 0.5, len(scene.views))
    return _Judged(
        scoring.ViewResult(index, linear, alpha, depth, ldr, photograph, transform),
        averaged,
        mask,
        {**score(ldr), **extra},
        score(averaged),
        scores_all,
        sample,
        scale,
        meter(linear, alpha),
    )


def _all_fitted(
    linear, photograph, still, start: display.DisplayTransform, score, alpha
) -> dict[str, Any] | None:
    """Score a held-out view with all parameters fitted that vary per view; None: only exposure.

    They are fitted to static pixels, starting from the fitted exposure.
    """
    tone = start.formation
    gamma, balance = MODELS[tone.model].gamma == "view", tone.white_balance == "view"
    if not (gamma or balance):
        return None
    images = (linear, photograph, still)
    model = (start.capture, tone, start.correction, start.matte(alpha))
    found = fit_capture(*images, *model, gamma=gamma, white_balance=balance)
    transform = display.with_capture(start, found)
    row = {**score(display.develop(linear, transform, alpha=alpha)), "exposure": transform.exposure}
    if gamma:
        row["gamma"] = transform.gamma
    if balance:
        row["red_green_ev"], row["blue_green_ev"] = transform.white_balance_ev
    return row


class _Views:
    """Collects scored views, and computes scores that need all of them."""

    def __init__(self, judge: Judge, render: Callable[[Camera], Render], radiance: Truth | None):
        self._judge, self._render, self._radiance = judge, render, radiance
        self._depths = DepthScores(judge.scene, judge.store)
        self._rows: dict[str, dict[str, dict]] = defaultdict(dict)
        self._videos = {
            name: scoring.VideoScores() for name in ("per_view", "averaged", "photographs")
        }
        # Names of views without scores, and of photographs with unknown exposures.
        self._unknown: dict[str, list[str]] = {"hidden": [], "exposures_unknown": []}
        self._readings: dict[int, Readings] = {}  # by row of the view
        self._scales: dict[int, float] = {}
        self._samples: dict[int, np.ndarray] = {}

    def add(self, found: _Judged) -> None:
        result, judge = found.result, self._judge
        view, index = judge.scene.views[result.index], result.index
        tells = scoring.tells_exposure(result.photograph, found.mask, judge.cfg.loss)
        if not tells:
            self._unknown["hidden" if tells is None else "exposures_unknown"].append(view.name)
        if tells is None:
            return
        self._rows[view.split][view.name] = found.scores
        self._rows[f"{view.split} averaged"][view.name] = found.scores_averaged
        if found.scores_all is not None:
            self._rows["all"][view.name] = found.scores_all
        if found.sample is not None:
            self._samples[index] = found.sample
        if found.scale is not None:
            self._scales[index] = found.scale
        self._readings[index] = found.readings
        self._depths.add(result, found.mask)
        exposure = result.transform.exposure
        self._videos["per_view"].add(view.camera, result.ldr, exposure)
        self._videos["averaged"].add(view.camera, found.averaged, judge.mean.exposure)
        self._videos["photographs"].add(view.camera, result.photograph, exposure)

    def evaluation(self) -> Evaluation:
        """Return all scores; protocols that need all views take a second pass over some views."""
        judge, rows = self._judge, self._rows
        exposures = np.asarray(judge.small.photometry.exposures)
        train, tone = scoring.summary_of(rows["train"]), judge.cfg.photometry
        per_view = train.pop("per_view", {})
        metrics: dict[str, Any] = {
            "train": {**train, "averaged": scoring.summary_of(rows["train averaged"])},
            "test": {
                "averaged": scoring.summary_of(rows["test averaged"]),
                "exposure_fitted": scoring.summary_of(rows["test"]),
            },
            **{key: names for key, names in self._unknown.items() if names},
        }
        metrics["train"]["per_view"] = per_view
        if rows["all"]:
            metrics["test"]["photometry_fitted"] = scoring.summary_of(rows["all"])
        logs, gamma = np.log(np.asarray(exposures, float)), judge.mean.gamma
        trained = [index for index in self._readings if index in judge.row_of]
        metering = fit_metering(
            [judge.scene.views[index].name for index in trained],
            [self._readings[index] for index in trained],
            logs[[judge.row_of[index] for index in trained]],
            exposed_at(BELOW_WHITE, gamma, tone),
        )
        metrics["consistency"] = {name: video.summary() for name, video in self._videos.items()}
        exposed = exposed_at(judge.cfg.loss.saturation, gamma, tone)
        brightest = exposed / float(np.median(exposures))
        self._again(metrics, metering, brightest)
        metrics |= self._depths.summary()
        return Evaluation(metrics, metering)

    def _again(self, metrics: dict[str, Any], metering: Metering, brightest: float) -> None:
        """Render views again for the protocols that need all views, and add their scores.

        Held-out views get the exposure of the metering rule; other protocols compare with
        references of one common exposure and with true radiance.
        """
        judge, radiance, common = self._judge, self._radiance, {}
        if self._scales:
            scale = float(np.exp(np.median(np.log(list(self._scales.values())))))
            common = {"averaged": judge.mean.exposure, "scale_aligned": scale}
        held_out = set(self._readings) - set(judge.row_of)
        metered = held_out if metering.rule.meter is not None else set()
        aligned = None
        if self._samples:
            aligned = Alignment.of(list(self._samples.values()), brightest)

        def judged(index: int) -> dict[str, dict[str, Any]]:
            photograph, mask = judge.store.get(index)
            rendered, found = self._render(camera_of(judge.store, index)), {}
            linear, alpha = np.asarray(rendered.linear), np.asarray(rendered.alpha)
            if index in metered:
                exposure = metering.exposure(self._readings[index])
                ldr = display.develop(
                    linear, replace(judge.usual(index), exposure=exposure), alpha=alpha
                )
                score = judge.scorer(index, photograph, mask)
                found["metered"] = {**score(ldr), "exposure": exposure}
            if index in self._scales:
                found |= _against_reference(judge, index, linear, alpha, mask, common)
            if aligned is not None and index in self._samples and radiance is not None:
                found["radiance"] = aligned.scores(linear, radiance(index), mask > 0.5)
            return found

        indices = sorted({*metered, *self._scales, *self._samples})
        rows: dict[str, dict[str, dict]] = defaultdict(dict)
        for index, found in zip(indices, map_in_order(judged, indices), strict=True):
            for name, row in found.items():
                rows[name][judge.scene.views[index].name] = row
        splits = {view.name: view.split for view in judge.scene.views}
        if rows["metered"]:
            metrics["test"]["metered"] = scoring.summary_of(rows["metered"])
        if aligned is not None:
            metrics["radiance"] = aligned.summary(rows["radiance"], splits)
        for name, exposure in common.items():
            scored = {**scoring.summary_of(rows[name]), "exposure": exposure}
            for part in ("train", "test"):
                of_part = {n: row for n, row in rows[name].items() if splits[n] == part}
                scored[part] = scoring.summary_of(of_part)
            metrics.setdefault("reference", {})[name] = scored


def _against_reference(
    judge: Judge, index: int, linear, alpha, mask, exposures: dict[str, float]
) -> dict[str, dict[str, Any]]:
    """Score a view against its photograph of the common exposure, under exposures by protocol.

    References are assumed to have no vignetting and the mean white balance.
    """
    assert judge.reference is not None
    truth, usual = judge.reference(index), judge.usual(None)
    shown = {name: replace(usual, exposure=exposure) for name, exposure in exposures.items()}
    score = functools.partial(scoring.view_scores, judge.lpips_weights, target=truth, mask=mask)
    return {n: score(display.develop(linear, t, alpha=alpha)) for n, t in shown.items()}
