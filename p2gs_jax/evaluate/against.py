"""Renders of other programs, judged as a run is: the same views, masks and scores.

A program that knows no exposures is compared by `as_rendered`, as the field does it, and by
`exposure_fitted`, which gives it what held-out views of a run get: one scalar a view, applied to
the radiance that its pictures show under the run's usual display.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import numpy as np

from p2gs_jax.config import FitConfig
from p2gs_jax.evaluate.drives import is_drive, masks_of_parts
from p2gs_jax.evaluate.light_of_renders import Light, light_of
from p2gs_jax.evaluate.lpips import LpipsWeights
from p2gs_jax.evaluate.moving import still_mask
from p2gs_jax.evaluate.parallel import map_in_order
from p2gs_jax.evaluate.renders_of_others import OtherRenders, in_order, orders
from p2gs_jax.evaluate.view_scores import Collector, view_scores
from p2gs_jax.photometry.display import DisplayTransform, mean_parameters, usual_display
from p2gs_jax.scene.images import ImageStore
from p2gs_jax.types import Params, Scene

Reference = Callable[[int], np.ndarray | None]
# Protocols of a run that are set beside those of other programs.
OWN = ("averaged", "exposure_fitted")
# How many pictures are looked at to tell two orders of views apart.
MOST_LOOKED_AT = 8


class Judge(NamedTuple):
    """What renders are judged by.

    Attributes:
        scene: the views.
        store: their photographs.
        params: the run's; its small arrays say how views are shown.
        cfg: formation model.
        lpips_weights: or None, which leaves LPIPS out.
        reference: view row -> photograph under one common exposure, or None.
    """

    scene: Scene
    store: ImageStore
    params: Params
    cfg: FitConfig
    lpips_weights: LpipsWeights | None = None
    reference: Reference | None = None


def check_renders(found: OtherRenders, scene: Scene, store: ImageStore) -> OtherRenders:
    """Read all renders once, so that what is wrong with them is said before anything long.

    Args:
        found: from `find_renders`.
        scene: the views.
        store: their photographs.

    Returns:
        The same; numbered ones in that order of `orders` in which they are nearer to the
        photographs.

    Raises:
        UserError: see `OtherRenders.read`.
    """
    for row in found.files:
        found.read(row, _size(store, row), over=store.backdrop is not None)
    possible = orders(scene) if found.numbered else []
    if len(possible) < 2:
        return found
    files = list(found.files.values())
    # Only places where the orders differ tell anything.
    where = [k for k in range(len(files)) if len({order[k] for order in possible}) > 1]
    where = where[:MOST_LOOKED_AT]

    def distance(order: tuple[int, ...]) -> float:
        as_views = in_order(found, order)
        return sum(_distance(as_views, order[k], store) for k in where)

    sizes = {_size(store, row) for row in found.files}
    return in_order(found, min(possible, key=distance)) if len(sizes) == 1 else found


def _size(store: ImageStore, row: int) -> tuple[int, int]:
    width, height = store.camera(row)[2:]
    return width, height


def _distance(found: OtherRenders, row: int, store: ImageStore) -> float:
    """Return the mean squared distance of a render from a photograph."""
    photograph, mask = store.get(row)
    pixels = found.read(row, _size(store, row)).pixels
    return float(np.mean(mask[..., None] * (pixels - photograph) ** 2))


def judge_renders(
    found: OtherRenders,
    judge: Judge,
    on_progress: Callable[[int, int], None] = lambda done, count: None,
) -> dict[str, Any]:
    """Return the scores of renders of held-out views.

    Args:
        found: from `check_renders`.
        judge: by what.
        on_progress: views done, views in all.

    Returns:
        `as_rendered` and `exposure_fitted`, as the protocols of `metrics.json`; where there are
        reference photographs `reference` with `as_rendered` and `scale_aligned`.

    Raises:
        UserError: see `OtherRenders.read`.
    """
    scene, store, tone = judge.scene, judge.store, judge.cfg.photometry
    small = jax.tree.map(np.asarray, replace(judge.params, gaussians=None))
    taken_by = [view.camera for view in scene.training_views]
    mean = mean_parameters(small.photometry)
    drive = is_drive(scene)

    def light(row: int, shown: DisplayTransform) -> Light:
        rendered = found.read(row, _size(store, row), over=store.backdrop is not None)
        if rendered.linear:
            shown = replace(shown, exposure=mean.exposure)
        return light_of(rendered, shown, store, row)

    def judged(row: int) -> tuple[str, dict[str, Any], dict[str, Any]]:
        view = scene.views[row]
        photograph, mask = store.get(row)
        parts = masks_of_parts(scene, row, mask) if drive else None
        shown = usual_display(small, taken_by, view.camera, tone)
        rendered = light(row, shown)
        fitted = rendered.fitted(photograph, still_mask(scene, row, mask))
        score = functools.partial(view_scores, judge.lpips_weights, parts=parts)
        return (
            view.name,
            score(rendered.picture, photograph, mask),
            {**score(rendered.under(fitted), photograph, mask), "exposure": fitted.exposure},
        )

    as_rendered, exposure_fitted = Collector(), Collector()
    rows = sorted(found.files)
    for done, (name, plain, fitted) in enumerate(map_in_order(judged, rows), 1):
        as_rendered.add(name, plain)
        exposure_fitted.add(name, fitted)
        on_progress(done, len(rows))
    scores = {"as_rendered": as_rendered.summary(), "exposure_fitted": exposure_fitted.summary()}
    if judge.reference is not None:
        everywhere = usual_display(small, (), None, tone)
        compared = [row for row in rows if judge.reference(row) is not None]
        if compared:
            scores["reference"] = _against_reference(
                compared, judge, lambda row: light(row, everywhere)
            )
    return scores


def _against_reference(
    rows: Iterable[int], judge: Judge, light: Callable[[int], Light]
) -> dict[str, Any]:
    """Score renders against photographs of one common exposure.

    Args:
        rows: of the views that have one.
        judge: by what.
        light: row -> what its render shows.
    """
    assert judge.reference is not None
    as_rendered, aligned = Collector(), Collector()
    exposures, rows = [], list(rows)
    for row in rows:
        target, mask = judge.reference(row), judge.store.get(row)[1]
        assert target is not None
        rendered = light(row)
        exposures.append(rendered.fitted(target, mask).exposure)
        plain = view_scores(judge.lpips_weights, rendered.picture, target, mask)
        as_rendered.add(judge.scene.views[row].name, plain)
    common = float(np.exp(np.median(np.log(exposures))))
    for row in rows:
        target, mask = judge.reference(row), judge.store.get(row)[1]
        rendered = light(row)
        ldr = rendered.under(replace(rendered.shown, exposure=common))
        aligned.add(
            judge.scene.views[row].name, view_scores(judge.lpips_weights, ldr, target, mask)
        )
    return {
        "as_rendered": as_rendered.summary(),
        "scale_aligned": {**aligned.summary(), "exposure": common},
    }


def own_scores(metrics: dict[str, Any], names: Iterable[str]) -> dict[str, Any]:
    """Return the scores of a run over some of its held-out views.

    Args:
        metrics: as `metrics.json`.
        names: of the views.
    """
    wanted = list(names)

    def over(part: dict[str, Any]) -> dict[str, Any]:
        return Collector({n: part["per_view"][n] for n in wanted}).summary()

    return {name: over(metrics["test"][name]) for name in OWN}
