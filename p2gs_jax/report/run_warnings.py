"""Warnings about a run: what its files show, and what to do about it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from p2gs_jax.photometry.models import MODELS
from p2gs_jax.photometry.solution import MIN_OBSERVATIONS, WEAK_GAMMA
from p2gs_jax.report.run_files import RunFiles, number_at
from p2gs_jax.report.run_summary import against_exif, count
from p2gs_jax.report.scene_measurements import SceneMeasurements
from p2gs_jax.run.photometry_files import ViewPhotometry

# Least gap between the PSNR of training and held-out views, dB.
WIDE_GAP = 4.0
# Least gap between one held-out view and the median of all, dB.
OUTLIER = 6.0
# Least standard error of an exposure, stops.
WEAK_EV = 0.1
# Least drift of an exposure from its start, stops; it must exceed three standard errors as well.
DRIFT_EV = 0.1
# Gammas of cameras lie between these: two priors' widths about 2.2 (`A_PRIOR` in
# photometry/adjustment/system.py).
GAMMAS = (1.65, 3.15)
# The floor of exposures and gammas in the `linear` parameterisation (types.py).
FLOOR = 1e-3
# Least share of clipped pixels of a photograph.
CLIPPED = 0.25
# Least rise of the PSNR between the last two tenths of a run, dB.
STILL_RISING = 0.3
FINISHED = 0.99
MOST_NAMES = 5


class RunWarning(NamedTuple):
    """A warning about a run.

    Attributes:
        title: in a few words.
        text: what was found and what to do.
    """

    title: str
    text: str


def run_warnings(run: RunFiles, scene: SceneMeasurements) -> list[RunWarning]:
    """Return all warnings, the most serious first."""
    checks: tuple[Callable[[], RunWarning | None], ...] = (
        lambda: _not_finite(run),
        lambda: _ended_early(run),
        lambda: _without_exposure(run),
        lambda: _generalisation(run),
        lambda: _outlier(run),
        lambda: _nothing_held_out(run),
        lambda: _equalising_loss(run),
        lambda: _exif(run),
        lambda: _weak_exposures(run),
        lambda: _few_observations(run),
        lambda: _gammas(run),
        lambda: _weak_gammas(run),
        lambda: _at_the_floor(run),
        lambda: _drift(run),
        lambda: _clipped(scene),
        lambda: _no_room(run),
        lambda: _still_rising(run),
    )
    return [found for check in checks if (found := check()) is not None]


def named(names: Sequence[str]) -> str:
    """Return the first few names, and how many more there are."""
    listed = ", ".join(names[:MOST_NAMES])
    rest = len(names) - MOST_NAMES
    return listed if rest <= 0 else f"{listed} and {rest} more"


def _not_finite(run: RunFiles) -> RunWarning | None:
    parts = [run.part("train", "per_view"), run.part("test", "exposure_fitted", "per_view")]
    broken = [
        name for part in parts for name, scores in part.items() if number_at(scores, "psnr") is None
    ]
    steps = [int(r["step"]) for r in run.log if number_at(r, "loss") is None]
    if not broken and not steps:
        return None
    where = [f"the scores of {named(broken)}"] if broken else []
    where += [f"the loss at step {steps[0]}"] if steps else []
    return RunWarning(
        "Not finite",
        f"{' and '.join(where).capitalize()} are not finite numbers. Do not trust this run; fit "
        "again with lower learning rates (--optimizer.*).",
    )


def _ended_early(run: RunFiles) -> RunWarning | None:
    progress = number_at(run.log[-1], "progress") if run.log else None
    if progress is None or progress >= FINISHED:
        return None
    return RunWarning(
        "Ended early",
        f"The log ends at {progress:.0%} of the schedule: the budget was too short, or the run was "
        "stopped. Continue it with --resume, or give it more time.",
    )


def _without_exposure(run: RunFiles) -> RunWarning | None:
    names = [v["image"] for v in run.train if v["exposure"] is None]
    if not names:
        return None
    return RunWarning(
        "Views without an exposure",
        f"{count(len(names), 'training view')} got no exposure ({named(names)}): nothing ties them "
        "to the others. They are shown at the mean of the rest.",
    )


def _fitted(run: RunFiles) -> str:
    """Return the protocol that fits most of a held-out view's photometry."""
    richer = "photometry_fitted"
    return richer if run.part("test", richer) else "exposure_fitted"


def _generalisation(run: RunFiles) -> RunWarning | None:
    train = run.number("train", "psnr")
    held_out = run.number("test", _fitted(run), "psnr")
    if train is None or held_out is None or train - held_out < WIDE_GAP:
        return None
    solved = _fitted(run).removesuffix("_fitted").replace("_", " ")
    return RunWarning(
        "New views are worse than training views",
        f"Training photographs are met at {train:.1f} dB, held-out ones at {held_out:.1f} dB, even "
        f"with {solved} fitted to each. Either the held-out views look where few others do, or "
        "there are too few photographs for this many Gaussians: add photographs, or give fewer "
        "Gaussians with --gaussians.",
    )


def _outlier(run: RunFiles) -> RunWarning | None:
    per_view = run.part("test", _fitted(run), "per_view")
    scores = {n: s for n, v in per_view.items() if (s := number_at(v, "psnr")) is not None}
    if len(scores) < 3:
        return None
    middle = float(np.median(list(scores.values())))
    bad = sorted((n for n in scores if scores[n] < middle - OUTLIER), key=lambda n: scores[n])
    if not bad:
        return None
    listed = [f"{n} {scores[n]:.1f} dB" for n in bad]
    return RunWarning(
        "Some held-out views fail",
        f"{named(listed)}, against a median of {middle:.1f} dB. Look at them below: often such a "
        "view shows a corner that no training view sees.",
    )


def _nothing_held_out(run: RunFiles) -> RunWarning | None:
    if not run.views or any(v["split"] == "test" for v in run.views):
        return None
    return RunWarning(
        "Nothing was held out",
        "Every photograph was trained on, so nothing here tells how good new views are. Fit with "
        "--test-every 8 to find out.",
    )


def _equalising_loss(run: RunFiles) -> RunWarning | None:
    weight, form = (run.option("loss", "relative_exposure", name) for name in ("weight", "form"))
    if weight is None or form != "literal_same_pose":
        return None
    return RunWarning(
        "A loss pulls exposures together",
        "The relative-exposure loss as printed in the paper is smallest when all exposures are "
        "equal, so the recovered ones are too close to each other. The preset robust leaves it "
        "out.",
    )


def _exif(run: RunFiles) -> RunWarning | None:
    agreement = against_exif(run)
    if agreement is None or not agreement.disagrees.any():
        return None
    views = [v for v in run.train if v["exposure_ev"] is not None]
    off = np.flatnonzero(agreement.disagrees)
    off = off[np.argsort(-np.abs(agreement.gap_ev[off]))]
    listed = [f"{views[i]['image']} {agreement.gap_ev[i]:+.2f}" for i in off]
    return RunWarning(
        "EXIF disagrees with the pixels",
        f"In {len(off)} of {agreement.views} views the exposure recovered from the pixels differs "
        f"from EXIF's by more than 0.2 stops ({named(listed)}). EXIF knows nothing of flare, "
        "vignetting, or what the camera did after the exposure; the fit used the pixels.",
    )


def _weak_exposures(run: RunFiles) -> RunWarning | None:
    weak = [(v["image"], e) for v in run.train if (e := v.get("exposure_ev_error") or 0) > WEAK_EV]
    if not weak:
        return None
    weak.sort(key=lambda w: -w[1])
    listed = [f"{n} ± {e:.2f}" for n, e in weak]
    return RunWarning(
        "Exposures are only roughly known",
        f"{count(len(weak), 'view')} with a standard error above {WEAK_EV:g} stops: "
        f"{named(listed)}. They share few points with the others; more overlap would help.",
    )


def _few_observations(run: RunFiles) -> RunWarning | None:
    few = [
        f"{v['image']} ({v.get('observations')})"
        for v in run.train
        if (v.get("observations") or MIN_OBSERVATIONS) < MIN_OBSERVATIONS
    ]
    if not few:
        return None
    return RunWarning(
        "Views with few shared points",
        f"{named(few)}: fewer than {MIN_OBSERVATIONS} usable observations each, so their exposures "
        "rest on little.",
    )


def _gammas(run: RunFiles) -> RunWarning | None:
    low, high = GAMMAS
    off = [v for v in run.train if v["gamma"] is not None and not low < v["gamma"] < high]
    curve = {} if run.photometry is None else run.photometry["curve"]
    if not off or curve.get("name") == "linear":
        return None
    listed = [f"{v['image']} {v['gamma']:.2f}" for v in off]
    return RunWarning(
        "Unusual gammas",
        f"{named(listed)}: outside {low:g} to {high:g}, where cameras lie. Gamma may have taken "
        "over what exposure or the tone curve should explain; compare with a model without it "
        "(--photometry.no-select --photometry.model view_exposure).",
    )


def _weak_gammas(run: RunFiles) -> RunWarning | None:
    model = "" if run.photometry is None else run.photometry["model"]
    if model not in MODELS or MODELS[model].gamma is None:
        return None
    weak = [v for v in run.train if (v.get("gamma_error") or 0) > WEAK_GAMMA]
    if not weak:
        return None
    names = [v["image"] for v in weak]
    return RunWarning(
        "Gammas are only roughly known",
        f"{count(len(weak), 'view')} with a standard error above {WEAK_GAMMA:g} ({named(names)}): "
        "the shared points there have nearly one brightness.",
    )


def _at_the_floor(run: RunFiles) -> RunWarning | None:
    def low(v: ViewPhotometry) -> bool:
        return any(x is not None and x <= 1.01 * FLOOR for x in (v["exposure"], v["gamma"]))

    names = [v["image"] for v in run.train if low(v)]
    if not names:
        return None
    return RunWarning(
        "Exposures at their floor",
        f"The exposure or gamma of {named(names)} fell to the smallest value it may have, "
        f"{FLOOR:g}. The fit lost these views; start exposures from tracks (preset robust).",
    )


def _drift(run: RunFiles) -> RunWarning | None:
    moved = []
    for v in run.train:
        start, end = v.get("exposure_ev_start"), v["exposure_ev"]
        if start is None or end is None:
            continue
        if abs(end - start) > max(DRIFT_EV, 3 * (v.get("exposure_ev_error") or 0)):
            moved.append((v["image"], end - start))
    if not moved:
        return None
    moved.sort(key=lambda m: -abs(m[1]))
    listed = [f"{n} {d:+.2f}" for n, d in moved]
    return RunWarning(
        "Exposures left their start",
        f"In {count(len(moved), 'view')} the fit moved the exposure by more than {DRIFT_EV:g} "
        f"stops and three standard errors from what the shared points said ({named(listed)}). One "
        "of the two is wrong; p2gs-jax calibrate RUN solves them anew through the rendered depth.",
    )


def _clipped(scene: SceneMeasurements) -> RunWarning | None:
    bad = sorted(((s, n) for n, s in scene.clipped.items() if s > CLIPPED), reverse=True)
    if not bad:
        return None
    listed = [f"{n} {s:.0%}" for s, n in bad]
    return RunWarning(
        "Clipped photographs",
        f"More than {CLIPPED:.0%} of the pixels are clipped in {len(bad)} of the "
        f"{len(scene.clipped)} photographs looked at ({named(listed)}). There the radiance is only "
        "known to be at least that bright, unless a darker photograph shows the same place.",
    )


def _no_room(run: RunFiles) -> RunWarning | None:
    refused = run.number("counts", "refused_densifications") or 0
    if refused <= 0:
        return None
    return RunWarning(
        "The Gaussians ran out of room",
        f"{refused:,.0f} times a Gaussian wanted to split and the limit was reached. Raise "
        "--gaussians if memory allows.",
    )


def _still_rising(run: RunFiles) -> RunWarning | None:
    rows = [
        (p, q)
        for r in run.log
        if (p := number_at(r, "progress")) is not None and (q := number_at(r, "psnr")) is not None
    ]
    before = [q for p, q in rows if 0.8 <= p < 0.9]
    last = [q for p, q in rows if p >= 0.9]
    if len(before) < 5 or len(last) < 5:
        return None
    rise = float(np.mean(last) - np.mean(before))
    # The rise must exceed the spread between views.
    noise = float(np.sqrt(np.var(last) / len(last) + np.var(before) / len(before)))
    if rise < max(STILL_RISING, 3 * noise):
        return None
    return RunWarning(
        "Not finished improving",
        f"The training PSNR rose by {rise:.1f} dB between the last two tenths of the run. More "
        "steps, or a longer --budget, would still help.",
    )
