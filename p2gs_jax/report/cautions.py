"""What to watch in a run, in plain words: found in its files, each with what to do about it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from p2gs_jax.photometry.models import MODELS
from p2gs_jax.photometry.solution import MIN_OBSERVATIONS, WEAK_GAMMA
from p2gs_jax.report.from_scene import FromScene
from p2gs_jax.report.run_files import RunFiles, number_at
from p2gs_jax.report.words import against_exif, count
from p2gs_jax.run.photometry_file import ViewPhotometry

# Held-out photographs met so much worse than training ones, dB.
WIDE_GAP = 4.0
# One held-out view so much worse than their median, dB.
OUTLIER = 6.0
# Standard error of an exposure, stops, from which on it is only roughly known.
WEAK_EV = 0.1
# Exposures that left their start by more than this, stops, and by three standard errors.
DRIFT_EV = 0.1
# Gammas of cameras lie between these: two priors' widths about 2.2 (`A_PRIOR` in
# photometry/adjustment/system.py).
GAMMAS = (1.65, 3.15)
# The floor of exposures and gammas in the `linear` parameterisation (types.py).
FLOOR = 1e-3
# Share of a photograph that is clipped from which on it matters.
CLIPPED = 0.25
# Rise of the PSNR between the last two tenths of a run, dB.
STILL_RISING = 0.3
FINISHED = 0.99
MOST_NAMES = 5


class Caution(NamedTuple):
    """Something to watch.

    Attributes:
        title: in a few words.
        text: what was found and what to do.
    """

    title: str
    text: str


def cautions(run: RunFiles, scene: FromScene) -> list[Caution]:
    """Return what to watch, the gravest first."""
    checks: tuple[Callable[[], Caution | None], ...] = (
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
    """Return some names in words, the first few of them."""
    listed = ", ".join(names[:MOST_NAMES])
    rest = len(names) - MOST_NAMES
    return listed if rest <= 0 else f"{listed} and {rest} more"


def _not_finite(run: RunFiles) -> Caution | None:
    parts = [run.part("train", "per_view"), run.part("test", "exposure_fitted", "per_view")]
    broken = [
        name for part in parts for name, scores in part.items() if number_at(scores, "psnr") is None
    ]
    steps = [int(r["step"]) for r in run.log if number_at(r, "loss") is None]
    if not broken and not steps:
        return None
    where = [f"the scores of {named(broken)}"] if broken else []
    where += [f"the loss at step {steps[0]}"] if steps else []
    return Caution(
        "Not finite",
        f"{' and '.join(where).capitalize()} are not finite numbers. Do not trust this run; fit "
        "again with lower learning rates (--optimizer.*).",
    )


def _ended_early(run: RunFiles) -> Caution | None:
    progress = number_at(run.log[-1], "progress") if run.log else None
    if progress is None or progress >= FINISHED:
        return None
    return Caution(
        "Ended early",
        f"The log ends at {progress:.0%} of the schedule: the budget was too short, or the run was "
        "stopped. Continue it with --resume, or give it more time.",
    )


def _without_exposure(run: RunFiles) -> Caution | None:
    names = [v["image"] for v in run.train if v["exposure"] is None]
    if not names:
        return None
    return Caution(
        "Views without an exposure",
        f"{count(len(names), 'training view')} got no exposure ({named(names)}): nothing ties them "
        "to the others. They are shown at the mean of the rest.",
    )


def _fitted(run: RunFiles) -> str:
    """Return the protocol that leaves least of a held-out view's own camera in its score."""
    both = "exposure_and_gamma_fitted"
    return both if run.part("test", both) else "exposure_fitted"


def _generalisation(run: RunFiles) -> Caution | None:
    train = run.number("train", "psnr")
    held_out = run.number("test", _fitted(run), "psnr")
    if train is None or held_out is None or train - held_out < WIDE_GAP:
        return None
    solved = _fitted(run).removesuffix("_fitted").replace("_", " ")
    return Caution(
        "New views are worse than training views",
        f"Training photographs are met at {train:.1f} dB, held-out ones at {held_out:.1f} dB, even "
        f"with {solved} fitted to each. Either the held-out views look where few others do, or "
        "there are too few photographs for this many Gaussians: add photographs, or try "
        "--gaussians auto.",
    )


def _outlier(run: RunFiles) -> Caution | None:
    per_view = run.part("test", _fitted(run), "per_view")
    scores = {n: s for n, v in per_view.items() if (s := number_at(v, "psnr")) is not None}
    if len(scores) < 3:
        return None
    middle = float(np.median(list(scores.values())))
    bad = sorted((n for n in scores if scores[n] < middle - OUTLIER), key=lambda n: scores[n])
    if not bad:
        return None
    listed = [f"{n} {scores[n]:.1f} dB" for n in bad]
    return Caution(
        "Some held-out views fail",
        f"{named(listed)}, against a median of {middle:.1f} dB. Look at them below: often such a "
        "view shows a corner that no training view sees.",
    )


def _nothing_held_out(run: RunFiles) -> Caution | None:
    if not run.views or any(v["split"] == "test" for v in run.views):
        return None
    return Caution(
        "Nothing was held out",
        "Every photograph was trained on, so nothing here tells how good new views are. Fit with "
        "--test-every 8 to find out.",
    )


def _equalising_loss(run: RunFiles) -> Caution | None:
    weight, form = (run.option("loss", "relative_exposure", name) for name in ("weight", "form"))
    if weight is None or form != "literal_same_pose":
        return None
    return Caution(
        "A loss pulls exposures together",
        "The relative-exposure loss as printed in the paper is smallest when all exposures are "
        "equal, so the recovered ones are too close to each other. The preset robust leaves it "
        "out.",
    )


def _exif(run: RunFiles) -> Caution | None:
    agreement = against_exif(run)
    if agreement is None or not agreement.disagrees.any():
        return None
    views = [v for v in run.train if v["exposure_ev"] is not None]
    off = np.flatnonzero(agreement.disagrees)
    off = off[np.argsort(-np.abs(agreement.gap_ev[off]))]
    listed = [f"{views[i]['image']} {agreement.gap_ev[i]:+.2f}" for i in off]
    return Caution(
        "EXIF disagrees with the pixels",
        f"In {len(off)} of {agreement.views} views the exposure recovered from the pixels differs "
        f"from EXIF's by more than 0.2 stops ({named(listed)}). EXIF knows nothing of flare, "
        "vignetting, or what the camera did after the exposure; the fit used the pixels.",
    )


def _weak_exposures(run: RunFiles) -> Caution | None:
    weak = [(v["image"], e) for v in run.train if (e := v.get("exposure_ev_error") or 0) > WEAK_EV]
    if not weak:
        return None
    weak.sort(key=lambda w: -w[1])
    listed = [f"{n} ± {e:.2f}" for n, e in weak]
    return Caution(
        "Exposures are only roughly known",
        f"{count(len(weak), 'view')} with a standard error above {WEAK_EV:g} stops: "
        f"{named(listed)}. They share few points with the others; more overlap would help.",
    )


def _few_observations(run: RunFiles) -> Caution | None:
    few = [
        f"{v['image']} ({v.get('observations')})"
        for v in run.train
        if (v.get("observations") or MIN_OBSERVATIONS) < MIN_OBSERVATIONS
    ]
    if not few:
        return None
    return Caution(
        "Views with few shared points",
        f"{named(few)}: fewer than {MIN_OBSERVATIONS} usable observations each, so their exposures "
        "rest on little.",
    )


def _gammas(run: RunFiles) -> Caution | None:
    low, high = GAMMAS
    off = [v for v in run.train if v["gamma"] is not None and not low < v["gamma"] < high]
    curve = {} if run.photometry is None else run.photometry["curve"]
    if not off or curve.get("name") == "linear":
        return None
    listed = [f"{v['image']} {v['gamma']:.2f}" for v in off]
    return Caution(
        "Unusual gammas",
        f"{named(listed)}: outside {low:g} to {high:g}, where cameras lie. Gamma may have taken "
        "over what exposure or the tone curve should explain; compare with a model without it "
        "(--photometry.no-select --photometry.model view_exposure).",
    )


def _weak_gammas(run: RunFiles) -> Caution | None:
    model = "" if run.photometry is None else run.photometry["model"]
    if model not in MODELS or MODELS[model].gamma is None:
        return None
    weak = [v for v in run.train if (v.get("gamma_error") or 0) > WEAK_GAMMA]
    if not weak:
        return None
    names = [v["image"] for v in weak]
    return Caution(
        "Gammas are only roughly known",
        f"{count(len(weak), 'view')} with a standard error above {WEAK_GAMMA:g} ({named(names)}): "
        "the shared points there have nearly one brightness.",
    )


def _at_the_floor(run: RunFiles) -> Caution | None:
    def low(v: ViewPhotometry) -> bool:
        return any(x is not None and x <= 1.01 * FLOOR for x in (v["exposure"], v["gamma"]))

    names = [v["image"] for v in run.train if low(v)]
    if not names:
        return None
    return Caution(
        "Exposures at their floor",
        f"The exposure or gamma of {named(names)} fell to the smallest value it may have, "
        f"{FLOOR:g}. The fit lost these views; start exposures from tracks (preset robust).",
    )


def _drift(run: RunFiles) -> Caution | None:
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
    return Caution(
        "Exposures left their start",
        f"In {count(len(moved), 'view')} the fit moved the exposure by more than {DRIFT_EV:g} "
        f"stops and three standard errors from what the shared points said ({named(listed)}). One "
        "of the two is wrong; p2gs-jax calibrate RUN solves them anew through the rendered depth.",
    )


def _clipped(scene: FromScene) -> Caution | None:
    bad = sorted(((s, n) for n, s in scene.clipped.items() if s > CLIPPED), reverse=True)
    if not bad:
        return None
    listed = [f"{n} {s:.0%}" for s, n in bad]
    return Caution(
        "Clipped photographs",
        f"More than {CLIPPED:.0%} of the pixels are clipped in {len(bad)} of the "
        f"{len(scene.clipped)} photographs looked at ({named(listed)}). There the radiance is only "
        "known to be at least that bright, unless a darker photograph shows the same place.",
    )


def _no_room(run: RunFiles) -> Caution | None:
    refused = run.number("counts", "refused_densifications") or 0
    if refused <= 0:
        return None
    return Caution(
        "The Gaussians ran out of room",
        f"{refused:,.0f} times a Gaussian wanted to split and the limit was reached. Raise "
        "--gaussians if memory allows.",
    )


def _still_rising(run: RunFiles) -> Caution | None:
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
    # Views differ in how hard they are: the rise must be clear of that.
    noise = float(np.sqrt(np.var(last) / len(last) + np.var(before) / len(before)))
    if rise < max(STILL_RISING, 3 * noise):
        return None
    return Caution(
        "Not finished improving",
        f"The training PSNR rose by {rise:.1f} dB between the last two tenths of the run. More "
        "steps, or a longer --budget, would still help.",
    )
