"""Evaluation of a finished fit: every view under every protocol.

Protocols (docs/photometry.md, 6): `per_view` renders a training view with its own exposure, gamma
and white balance; `averaged` uses the mean parameters over the training views (paper, Rendering
for evaluation); `exposure_fitted` solves one scalar exposure from the photograph, because a
held-out view has none of its own; `photometry_fitted` solves all that the model gives every view,
where that is more than an exposure; `metered` takes the exposure that the rule gives its render
that explains the training exposures, where there is one (photometry/metering.py); against
reference photographs of one common exposure, `scale_aligned` solves one scalar for all of them.
Vignetting and responses are the camera's in all. Where photographs have alpha, they and the renders
are put over the same background (photometry/matte.py).
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float32

from p2gs_jax.config import FitConfig
from p2gs_jax.evaluate.alignment import fit_capture, with_fitted_exposure
from p2gs_jax.evaluate.array_store import ArrayStore, StoredArray, most_bytes
from p2gs_jax.evaluate.consistency import VideoScores
from p2gs_jax.evaluate.drives import DriveScores, is_drive, masks_of_parts
from p2gs_jax.evaluate.lpips import LpipsWeights
from p2gs_jax.evaluate.metered import MeteredViews
from p2gs_jax.evaluate.moving import still_mask
from p2gs_jax.evaluate.parallel import map_in_order
from p2gs_jax.evaluate.radiance import RadianceScores, Truth
from p2gs_jax.evaluate.unexplained import Unexplained
from p2gs_jax.evaluate.untold import Untold
from p2gs_jax.evaluate.view_scores import Collector, view_scores
from p2gs_jax.photometry.display import DisplayTransform, develop, display_of_view, with_capture
from p2gs_jax.photometry.formation import exposed_at
from p2gs_jax.photometry.mean import MeanParameters, mean_parameters, usual_display
from p2gs_jax.photometry.metering import Metering, Readings, meter
from p2gs_jax.photometry.models import MODELS
from p2gs_jax.render.capacity import RenderView
from p2gs_jax.scene.device import camera_of
from p2gs_jax.scene.images import ImageStore
from p2gs_jax.types import Params, Scene


@dataclass(frozen=True)
class ViewResult:
    """One rendered view.

    Attributes:
        index: row in `Scene.views`.
        linear: linear radiance.
        alpha: opacity.
        depth: alpha-weighted depth.
        ldr: display image under `transform`.
        photograph: of the view.
        transform: the view's own; of a held-out view the usual one with the exposure fitted to its
            photograph.
    """

    index: int
    linear: Float32[np.ndarray, "h w 3"]
    alpha: Float32[np.ndarray, "h w"]
    depth: Float32[np.ndarray, "h w"]
    ldr: Float32[np.ndarray, "h w 3"]
    photograph: Float32[np.ndarray, "h w 3"]
    transform: DisplayTransform


class _Judged(NamedTuple):
    """A view with its scores, and the references that need all views to compare with.

    Attributes:
        result: the view.
        ldr_averaged: display image with the mean parameters.
        mask: which pixels count.
        scores: of `result.ldr`.
        scores_averaged: of `ldr_averaged`.
        scores_all: of a held-out view with all fitted that varies per view, or None.
        radiance: true linear radiance, or None.
        reference: photograph under the common exposure, or None.
        readings: of the meters.
    """

    result: ViewResult
    ldr_averaged: Float32[np.ndarray, "h w 3"]
    mask: Float32[np.ndarray, "h w"]
    scores: dict[str, Any]
    scores_averaged: dict[str, Any]
    scores_all: dict[str, Any] | None
    radiance: np.ndarray | None
    reference: np.ndarray | None
    readings: Readings


def evaluate(
    params: Params,
    alive: Bool[np.ndarray, " n"],
    scene: Scene,
    store: ImageStore,
    render: RenderView,
    cfg: FitConfig,
    *,
    reference: Mapping[int, Float32[np.ndarray, "h w 3"]] | Callable | None = None,
    radiance: Truth | None = None,
    lpips_weights: LpipsWeights | None = None,
    on_view: Callable[[ViewResult], None] = lambda result: None,
    on_metering: Callable[[Metering], None] = lambda metering: None,
    on_unexplained: Callable[[dict[int, Unexplained]], None] = lambda found: None,
    on_progress: Callable[[int, int], None] = lambda done, count: None,
) -> dict:
    """Render and judge all views.

    Args:
        params: the fit.
        alive: which Gaussians exist.
        scene: views and their splits.
        store: photographs.
        render: from `make_renderer`; it knows which Gaussians belong to moving objects.
        cfg: formation model.
        reference: view row -> photograph under the common exposure, or None where there is none.
        radiance: view row -> true linear radiance at the size of the photographs, or None.
        lpips_weights: adds `lpips` wherever a view is compared with a photograph; None leaves it
            out.
        on_view: receives every rendered view.
        on_metering: receives the metering rule that explains the training views, once.
        on_unexplained: of a drive: receives what no static scene explains in the training views.
        on_progress: views done, views in all.

    Returns:
        The `train`, `test`, `consistency`, `reference` and `radiance` parts of `metrics.json`,
        those of drives, and the views that have no scores or no exposure (`Untold`).

    Raises:
        UserError: an image is too small for LPIPS.
    """
    mean = mean_parameters(params.photometry)
    # Small arrays stay on the host; large ones are moved to the device once.
    small = jax.tree.map(np.asarray, replace(params, gaussians=None))
    gaussians = jax.device_put(params.gaussians)
    living = jax.device_put(np.asarray(alive))
    taken_by = [view.camera for view in scene.training_views]

    tone = cfg.photometry

    def over(transform: DisplayTransform) -> DisplayTransform:
        return replace(transform, backdrop=store.backdrop_values)

    def usual(index: int) -> DisplayTransform:
        """Return how a view is shown by the mean parameters."""
        return over(usual_display(small, taken_by, scene.views[index].camera, tone))

    drive: DriveScores | None = None
    row_of = {index: row for row, index in enumerate(scene.train_indices)}

    def judged(index: int) -> _Judged:
        photograph, mask = store.get(index, 1)
        parts = None if drive is None else masks_of_parts(scene, index, mask)
        score = functools.partial(view_scores, lpips_weights, parts=parts)
        result = render(gaussians, living, camera_of(store, index))
        linear, alpha = np.asarray(result.linear), np.asarray(result.alpha)
        shown = usual(index)
        ldr_mean = develop(linear, replace(shown, exposure=mean.exposure), alpha=alpha)
        extra, everything = {}, None
        if scene.views[index].split == "train":
            transform = over(display_of_view(small, row_of[index], tone))
        elif not mask.any():
            transform = shown
        else:
            still = still_mask(scene, index, mask)
            transform = with_fitted_exposure(shown, linear, photograph, still, alpha)
            extra = {"exposure": transform.exposure}
            everything = _all_fitted(linear, photograph, (still, mask), transform, score, alpha)
        ldr = develop(linear, transform, alpha=alpha)
        depth = np.asarray(result.depth)
        return _Judged(
            ViewResult(index, linear, alpha, depth, ldr, photograph, transform),
            ldr_mean,
            mask,
            {**score(ldr, photograph, mask), **extra},
            score(ldr_mean, photograph, mask),
            everything,
            None if radiance is None else radiance(index),
            None if reference is None else _lookup(reference, index),
            meter(linear, alpha),
        )

    untold, told = Untold(), []
    own, averaged = Collector(), Collector()
    test_averaged, test_fitted, test_all = Collector(), Collector(), Collector()
    videos = {name: VideoScores() for name in ("per_view", "averaged", "photographs")}
    with ArrayStore(most_bytes(cfg.data.cache_mb)) as arrays:
        if is_drive(scene):
            seen = functools.partial(render, gaussians, living)
            drive = DriveScores(scene, store, seen, arrays)
        scores, metered = RadianceScores(arrays), MeteredViews(arrays)
        reference_views: list[tuple[int, tuple[StoredArray, ...]]] = []
        # In the order of names: the frames of a camera are then in sequence.
        for found in map_in_order(judged, range(len(scene.views))):
            result = found.result
            index, view = result.index, scene.views[result.index]
            training = view.split == "train"
            on_progress(index + 1, len(scene.views))
            if not untold.add(view.name, result.photograph, found.mask, cfg.loss):
                on_view(result)
                continue
            (own if training else test_fitted).add(view.name, found.scores)
            (averaged if training else test_averaged).add(view.name, found.scores_averaged)
            if found.scores_all is not None:
                test_all.add(view.name, found.scores_all)
            again = found.radiance is not None or found.reference is not None
            linear = arrays.put(result.linear) if again else result.linear
            if found.radiance is not None:
                scores.add(view.name, view.split, linear, found.radiance, found.mask)
            if found.reference is not None:
                images = (linear, found.reference, found.mask)
                images = images if store.backdrop is None else (*images, result.alpha)
                reference_views.append((index, tuple(map(arrays.put, images))))
            if training:
                told.append(row_of[index])
                metered.add_training(view.name, found.readings)
            else:
                images = (linear, result.photograph, found.mask)
                alpha = None if store.backdrop is None else result.alpha
                metered.add_held_out(view.name, found.readings, *images, alpha)
            on_view(result)
            if drive is not None:
                images = (result.ldr, result.photograph, found.mask)
                drive.add(index, *images, result.depth, result.alpha)
            videos["per_view"].add(view.camera, result.ldr, result.transform.exposure)
            videos["averaged"].add(view.camera, found.ldr_averaged, mean.exposure)
            videos["photographs"].add(view.camera, result.photograph, result.transform.exposure)

        metrics = {
            "train": {**own.summary(), "averaged": averaged.summary()},
            "test": {"averaged": test_averaged.summary(), "exposure_fitted": test_fitted.summary()},
            **untold.to_dict(),
        }
        if test_all.rows:
            metrics["test"]["photometry_fitted"] = test_all.summary()
        metering = metered.fit(np.asarray(small.photometry.exposures)[told], mean.gamma, tone)
        on_metering(metering)

        row_of_name = {view.name: index for index, view in enumerate(scene.views)}

        def under_rule(name, linear, exposure, photograph, mask, alpha):
            row = row_of_name[name]
            shown = develop(linear, replace(usual(row), exposure=exposure), alpha=alpha)
            parts = None if drive is None else masks_of_parts(scene, row, mask)
            return view_scores(lpips_weights, shown, photograph, mask, parts)

        if metered_scores := metered.scores(metering, under_rule):
            metrics["test"]["metered"] = Collector(metered_scores).summary()
        metrics["train"]["per_view"] = metrics["train"].pop("per_view", {})
        metrics["consistency"] = {name: video.summary() for name, video in videos.items()}
        if scores.views:
            exposed = exposed_at(cfg.loss.saturation, mean.gamma, cfg.photometry)
            typical = float(np.median(small.photometry.exposures))
            metrics["radiance"] = scores.summary(exposed / typical)
        if drive is not None:
            metrics |= drive.summary()
            on_unexplained(drive.unexplained)
        if reference_views:
            metrics["reference"] = _against_reference(
                reference_views,
                scene,
                mean,
                over(usual_display(small, (), None, tone)),
                functools.partial(view_scores, lpips_weights),
            )
        return metrics


def _all_fitted(
    linear, photograph, masks, start: DisplayTransform, score, alpha
) -> dict[str, Any] | None:
    """Score a held-out view with all solved that varies per view; None: that is one scalar.

    Args:
        linear: the render.
        photograph: display values.
        masks: what it is solved from, and what is scored.
        start: with the exposure alone.
        score: (display image, photograph, mask) -> scores by name.
        alpha: opacity of the render.
    """
    tone = start.formation
    gamma, balance = MODELS[tone.model].gamma == "view", tone.white_balance == "view"
    if not (gamma or balance):
        return None
    still, mask = masks
    given = (linear, photograph, still)
    how = (start.capture, tone, start.correction, start.matte(alpha))
    found = fit_capture(*given, *how, gamma=gamma, white_balance=balance)
    transform = with_capture(start, found)
    ldr = develop(linear, transform, alpha=alpha)
    row = {**score(ldr, photograph, mask), "exposure": transform.exposure}
    if gamma:
        row["gamma"] = transform.gamma
    if balance:
        row["red_green_ev"], row["blue_green_ev"] = transform.white_balance_ev
    return row


def _lookup(reference, index: int):
    return reference(index) if callable(reference) else reference.get(index)


def _against_reference(
    views, scene: Scene, mean: MeanParameters, shown: DisplayTransform, score
) -> dict:
    """Score all views against photographs of one common exposure.

    Those are taken to be what no camera in particular sees: without vignetting, and of mean white
    balance.

    Args:
        views: row of each; linear radiance, reference photograph and mask, kept; over a background
            also the opacity.
        scene: their names and splits.
        mean: exposures to show them at.
        shown: how all are shown, but for the exposure.
        score: (display image, photograph, mask) -> scores by name.
    """

    def images(view):
        return (kept.read() for kept in view[1])

    def scale(view) -> float:
        return with_fitted_exposure(shown, *images(view)).exposure

    scales = list(map_in_order(scale, views))
    common = float(np.exp(np.median(np.log(scales))))
    protocols = {
        "averaged": mean.exposure,
        "geometric": mean.exposure_geometric,
        "scale_aligned": common,
    }

    def judged(view):
        linear, truth, mask, *alpha = images(view)
        opacity = next(iter(alpha), None)
        return {
            name: score(
                develop(linear, replace(shown, exposure=exposure), alpha=opacity), truth, mask
            )
            for name, exposure in protocols.items()
        }

    parts = {name: {part: Collector() for part in ("all", "train", "test")} for name in protocols}
    for (index, *_), rows in zip(views, map_in_order(judged, views), strict=True):
        view = scene.views[index]
        for name, row in rows.items():
            for part in ("all", view.split):
                parts[name][part].add(view.name, row)
    out = {}
    for name, exposure in protocols.items():
        out[name] = {
            **parts[name]["all"].summary(),
            "exposure": exposure,
            "train": parts[name]["train"].summary(),
            "test": parts[name]["test"].summary(),
        }
    return out
