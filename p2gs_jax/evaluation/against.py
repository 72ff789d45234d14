"""Renders of other programs, evaluated like a run: the same views, masks and scores.

There are two protocols. `as_rendered` scores pictures unchanged, as published comparisons do, and
radiance at the run's mean exposure. `exposure_fitted` fits one exposure per view, as for held-out
views of a run. It scales radiance, into which the run's usual display transform decodes pictures.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float32

from p2gs_jax.core.threads import map_in_order
from p2gs_jax.errors import UserError
from p2gs_jax.evaluation.alignment import with_fitted_exposure
from p2gs_jax.evaluation.evaluate import Judge
from p2gs_jax.evaluation.renders_of_others import OtherRenders, Rendered
from p2gs_jax.evaluation.scores import still_mask, summary_of, view_scores
from p2gs_jax.photometry.display import DisplayTransform, develop, undevelop
from p2gs_jax.photometry.formation import LEAST_ALPHA
from p2gs_jax.scene.pixels.decode import floats
from p2gs_jax.scene.pixels.store import ImageStore

# Protocols of a run that correspond to `as_rendered` and `exposure_fitted`.
RUN_PROTOCOLS = ("averaged", "exposure_fitted")


def check_renders(found: OtherRenders, store: ImageStore) -> OtherRenders:
    """Read all renders once, so that errors precede long computations; return those to judge.

    Views that masks hide are left out. UserError: all are, or see `OtherRenders.read`.
    """
    for row in found.files:
        found.read(row, store.camera(row)[2:], over=store.backdrop is not None)
    files = {row: path for row, path in found.files.items() if store.get(row)[1].any()}
    if not files:
        why = f"masks hide every held-out view of which {found.folder} has a render."
        raise UserError(why, fix="render other views, or leave out --against")
    return replace(found, files=files)


def judge_renders(
    found: OtherRenders,
    judge: Judge,
    on_progress: Callable[[int, int], None] = lambda done, count: None,
) -> dict[str, Any]:
    """Return the scores of renders of held-out views; `found` comes from `check_renders`.

    They are `as_rendered` and `exposure_fitted`, as the protocols of `metrics.json`; with reference
    photographs also `reference` with `as_rendered` and `scale_aligned`. Raises UserError: see
    `OtherRenders.read`.
    """

    def light(row: int, shown: DisplayTransform) -> Light:
        over = judge.store.backdrop is not None
        rendered = found.read(row, judge.store.camera(row)[2:], over=over)
        if rendered.linear:
            shown = replace(shown, exposure=judge.mean.exposure)
        return light_of(rendered, shown, judge.store, row)

    def judged(row: int) -> tuple[dict[str, Any], dict[str, Any]]:
        photograph, mask = judge.store.get(row)
        score = judge.scorer(row, photograph, mask)
        linear, shown, picture, alpha = light(row, judge.usual(row))
        still = still_mask(judge.scene, row, mask)
        fitted = with_fitted_exposure(shown, linear, photograph, still, alpha)
        ldr = develop(linear, fitted, alpha=alpha)
        return score(picture), {**score(ldr), "exposure": fitted.exposure}

    rows = sorted(found.files)
    as_rendered, exposure_fitted = {}, {}
    for done, (row, (plain, fitted)) in enumerate(
        zip(rows, map_in_order(judged, rows), strict=True), 1
    ):
        name = judge.scene.views[row].name
        as_rendered[name], exposure_fitted[name] = plain, fitted
        on_progress(done, len(rows))
    scores = {
        "as_rendered": summary_of(as_rendered),
        "exposure_fitted": summary_of(exposure_fitted),
    }
    compared = [r for r in rows if judge.reference is not None and judge.reference(r) is not None]
    if compared:
        usual = judge.usual(None)
        scores["reference"] = _against_reference(compared, judge, lambda r: light(r, usual))
    return scores


def _against_reference(
    rows: list[int], judge: Judge, light: Callable[[int], Light]
) -> dict[str, Any]:
    """Score renders against the reference photographs, which have one common exposure."""
    assert judge.reference is not None
    as_rendered, aligned, exposures = {}, {}, []
    for row in rows:
        (linear, shown, picture, alpha), name = light(row), judge.scene.views[row].name
        target, mask = judge.reference(row), judge.store.get(row)[1]
        assert target is not None
        exposures.append(with_fitted_exposure(shown, linear, target, mask, alpha).exposure)
        as_rendered[name] = view_scores(judge.lpips_weights, picture, target, mask)
    common = float(np.exp(np.median(np.log(exposures))))
    for row in rows:
        (linear, shown, _, alpha), name = light(row), judge.scene.views[row].name
        target, mask = judge.reference(row), judge.store.get(row)[1]
        ldr = develop(linear, replace(shown, exposure=common), alpha=alpha)
        aligned[name] = view_scores(judge.lpips_weights, ldr, target, mask)
    return {
        "as_rendered": summary_of(as_rendered),
        "scale_aligned": {**summary_of(aligned), "exposure": common},
    }


def scores_of_run(metrics: dict[str, Any], names: Iterable[str]) -> dict[str, Any]:
    """Return the scores of a run, from its `metrics.json`, over some of its held-out views."""
    wanted, test = list(names), metrics["test"]
    of_wanted = {p: {n: test[p]["per_view"][n] for n in wanted} for p in RUN_PROTOCOLS}
    return {protocol: summary_of(rows) for protocol, rows in of_wanted.items()}


class Light(NamedTuple):
    """Radiance of a render, from which pictures under other exposures follow."""

    linear: Float32[np.ndarray, "h w 3"]  # radiance, premultiplied by `alpha`
    shown: DisplayTransform  # transform from the radiance to the picture
    picture: Float32[np.ndarray, "h w 3"]  # display values
    alpha: Float32[np.ndarray, "h w"] | None  # opacity over the backdrop; None: no backdrop


def light_of(rendered: Rendered, shown: DisplayTransform, store: ImageStore, row: int) -> Light:
    """Return the radiance that the render of a view shows.

    For a picture, the alpha of the photograph separates foreground and background; a render of
    radiance has its own opacity. An exposure changes the foreground only.
    """
    pixels, linear, opacity = rendered
    if linear:
        opacity = None if store.backdrop is None else opacity
        shown = replace(shown, backdrop=store.backdrop_values)
        return Light(pixels, shown, develop(pixels, shown, alpha=opacity), opacity)
    # A correction of display values belongs to renders of this run.
    shown = replace(shown, correction=None)
    found = store.alpha(row)
    if found is None:
        return Light(undevelop(pixels, shown), shown, pixels, None)
    alpha, backdrop = floats(found), np.asarray(store.backdrop, np.float32)
    covered, free = (np.maximum(a, LEAST_ALPHA)[..., None] for a in (alpha, 1 - alpha))
    front = np.clip((pixels - (1 - alpha[..., None]) * backdrop) / covered, 0, 1)
    behind = (pixels - alpha[..., None] * front) / free
    shown = replace(shown, backdrop=behind)
    return Light(covered * undevelop(front, shown), shown, pixels, alpha)
