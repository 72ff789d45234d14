"""The results of a run in sentences: the photometric model, and warnings with remedies."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from p2gs_jax.core.text import count_of, first_few
from p2gs_jax.photometry.models import MODELS
from p2gs_jax.photometry.solution import NOTICEABLE_EV, Agreement, compare
from p2gs_jax.report.run_files import RunFiles, number_at

CURVES = {
    "srgb": "the sRGB tone curve",
    "power": "a power-law tone curve",
    "spline": "a tone curve fitted to this camera",
    "linear": "no tone curve: the splats hold display values",
}
DESCRIPTIONS: dict[str, str] = {name: model.description for name, model in MODELS.items()}
CORRECTIONS = {
    "affine": "a colour matrix",
    "bilateral": "a bilateral grid",
    "curve": "a curve",
    "luminance": "colour axes and an enhancing curve",
}
# Smallest gap between the PSNR of training and held-out views that gives a warning, dB.
WIDE_GAP = 4.0
# Standard errors of exposures above this give a warning, stops.
WEAK_EV = 0.1
# Smallest rise of the PSNR between the last two tenths of a run that gives a warning, dB.
STILL_RISING = 0.3
FINISHED = 0.99  # runs that ended before this share of the schedule give a warning


def duration(seconds: float) -> str:
    """Return seconds in words, such as `5 min 12 s`."""
    whole = round(seconds)
    if whole < 100:
        return f"{seconds:.0f} s"
    minutes, rest = divmod(whole, 60)
    return f"{minutes} min {rest} s" if minutes < 100 else f"{minutes // 60} h {minutes % 60} min"


def cell(value: float | None, form: str) -> str:
    """Return a number as the text of a table's cell, empty if it is missing or not finite."""
    return format(value, form) if value is not None and np.isfinite(value) else ""


def column(values: Iterable, missing: float = np.nan) -> np.ndarray:
    """Return numbers as an array, with `missing` in place of each None."""
    return np.array([missing if v is None else v for v in values], float)


def modelled(run: RunFiles) -> str:
    """Return a sentence on the photometric model of the run."""
    if run.photometry is None:
        return "The photometric model is unknown because photometry.json is missing."
    model, curve = run.photometry["model"], run.photometry["curve"].get("name", "")
    kind, preset = run.option("photometry", "appearance"), f"The preset {run.preset}"
    if kind == "ppisp":
        return (
            f"{preset} fits a camera model together with the splats: exposure and colours of every "
            "view, vignetting and tone curve of every camera."
        )
    correction = f", with {CORRECTIONS.get(kind, kind)} fitted to every view" if kind else ""
    if curve == "linear" and model == "constant":
        return f"{preset} models no camera: the splats hold display values{correction}."
    reason = f"The preset {run.preset} or the options set this model."
    if run.option("photometry", "select"):
        # `metrics.json` has this part only after a photometric bundle adjustment.
        reason = "This is the simplest model that predicts held-out colours about as well as any."
        if not run.part("photometry"):
            reason = "This is the default, because no shared points were available for a choice."
    span = exposure_span(run)
    spans = "" if span is None or model == "constant" else f" The exposures span {span:.1f} stops."
    description, tone_curve = DESCRIPTIONS.get(model, model), CURVES.get(curve, curve)
    return f"The run models {description} under {tone_curve}{correction}. {reason}{spans}"


def exposure_span(run: RunFiles) -> float | None:
    """Return the stops between the darkest and the brightest training exposure."""
    values = [v["exposure_ev"] for v in run.train if v["exposure_ev"] is not None]
    return max(values) - min(values) if values else None


def notes_of(run: RunFiles) -> list[str]:
    """Return the notes of the fit, which include the reason for its photometric model."""
    notes = run.metrics.get("notes")
    return [str(n) for n in notes] if isinstance(notes, list) else []


def against_exif(run: RunFiles) -> Agreement | None:
    """Return the agreement of the exposures with EXIF; None if fewer than two views have both."""
    views = [v for v in run.train if v["exposure_ev"] is not None]
    if sum(v["exif_ev"] is not None for v in views) < 2:
        return None
    found, stated = (column(v[key] for v in views) for key in ("exposure_ev", "exif_ev"))
    return compare(found, column((v.get("exposure_ev_error") for v in views), 0.0), stated)


class RunWarning(NamedTuple):
    """A warning about a run: its title, and a text with the finding and the remedy."""

    title: str
    text: str


def run_warnings(run: RunFiles) -> list[RunWarning]:
    """Return all warnings, the most serious first."""
    named = [
        RunWarning(title, form.format(count=count_of(len(found), "view"), names=first_few(found)))
        for title, found, form in _on_views(run)
        if found
    ]
    return [*_on_the_run(run), *named, *_on_more_to_gain(run)]


def _worst(pairs: Iterable[tuple[str, float]], form: str) -> list[str]:
    """Return names with their numbers, from the largest absolute value on."""
    return [f"{name} {value:{form}}" for name, value in sorted(pairs, key=lambda p: -abs(p[1]))]


def _on_the_run(run: RunFiles) -> Iterator[RunWarning]:
    parts = [run.part("train", "per_view"), run.part("test", "exposure_fitted", "per_view")]
    broken = [n for part in parts for n, s in part.items() if number_at(s, "psnr") is None]
    steps = [int(r["step"]) for r in run.log if number_at(r, "loss") is None]
    where = [f"the scores of {first_few(broken)}"] if broken else []
    where += [f"the loss at step {steps[0]}"] if steps else []
    if where:
        yield RunWarning(
            "Not finite",
            f"{' and '.join(where).capitalize()} are not finite numbers. Do not trust this run. "
            "Repeat the fit with lower learning rates (--optimizer.*).",
        )
    progress = number_at(run.log[-1], "progress") if run.log else None
    if progress is not None and progress < FINISHED:
        yield RunWarning(
            "Ended early",
            f"The log ends at {progress:.0%} of the schedule: the run was stopped, or its budget "
            "was too short. To complete it, repeat the command of the fit with --resume (and with "
            "a longer --budget, if it had one).",
        )
    # The protocol that fits the most photometry of a held-out view comes first.
    fitted = [run.number("test", name, "psnr") for name in ("photometry_fitted", "exposure_fitted")]
    held_out = next((score for score in fitted if score is not None), None)
    train = run.number("train", "psnr")
    if train is not None and held_out is not None and train - held_out >= WIDE_GAP:
        yield RunWarning(
            "New views are worse than training views",
            f"The PSNR is {train:.1f} dB on training views, and {held_out:.1f} dB on held-out "
            "views although their exposures were fitted. Either few training views show the same "
            "places, or there are too few photographs for this many Gaussians. Add photographs, or "
            "lower --gaussians.",
        )


def _on_views(run: RunFiles) -> Iterator[tuple[str, list[str], str]]:
    """Yield titles, names of views, the worst first, and texts with `{count}` and `{names}`."""
    yield (
        "Views without an exposure",
        [v["image"] for v in run.train if v["exposure"] is None],
        "{count} got no exposure ({names}) because no surface points connect them with the others. "
        "They are rendered at the mean exposure of the others.",
    )
    agreement = against_exif(run)
    if agreement is not None:
        names = [v["image"] for v in run.train if v["exposure_ev"] is not None]
        off = [(names[i], agreement.gap_ev[i]) for i in np.flatnonzero(agreement.disagrees)]
        yield (
            "EXIF disagrees with the pixels",
            _worst(off, "+.2f"),
            f"In {{count}} of {agreement.views} the exposure recovered from the pixels differs "
            f"from that of EXIF by more than {NOTICEABLE_EV:g} stops ({{names}}). EXIF does not "
            "include flare, vignetting, or processing in the camera, so the fit used the pixels.",
        )
    errors = [(v["image"], v.get("exposure_ev_error") or 0.0) for v in run.train]
    yield (
        "Exposures are only roughly known",
        _worst((pair for pair in errors if pair[1] > WEAK_EV), ".2f"),
        f"The standard error exceeds {WEAK_EV:g} stops in {{count}}: {{names}}. They share few "
        "surface points with the others. Add photographs with more overlap.",
    )


def _on_more_to_gain(run: RunFiles) -> Iterator[RunWarning]:
    refused = run.number("counts", "refused_densifications") or 0
    if refused > 0:
        yield RunWarning(
            "The limit on Gaussians was reached",
            f"{refused:,.0f} splits of Gaussians were refused at the limit. Raise --gaussians if "
            "memory allows.",
        )
    both = [(number_at(r, "progress"), number_at(r, "psnr")) for r in run.log]
    rows = [(p, q) for p, q in both if p is not None and q is not None]
    before, last = [q for p, q in rows if 0.8 <= p < 0.9], [q for p, q in rows if p >= 0.9]
    if min(len(before), len(last)) >= 5:
        rise = float(np.mean(last) - np.mean(before))
        # The rise must exceed the spread between views.
        noise = float(np.sqrt(np.var(last) / len(last) + np.var(before) / len(before)))
        if rise >= max(STILL_RISING, 3 * noise):
            yield RunWarning(
                "Still improving at the end",
                f"The training PSNR rose by {rise:.1f} dB between the last two tenths of the run. "
                "Continue with --resume and more --steps or a longer --budget.",
            )
