"""The results of a run, in sentences."""

from __future__ import annotations

import numpy as np

from p2gs_jax.core.clock import whole_run
from p2gs_jax.evaluation.alignment import ExposureError, exposure_error
from p2gs_jax.photometry.agreement import Agreement, compare
from p2gs_jax.photometry.models import MODELS
from p2gs_jax.report.run_files import RunFiles
from p2gs_jax.report.scene_measurements import SceneMeasurements

CURVES = {
    "srgb": "the sRGB tone curve",
    "power": "a power-law tone curve",
    "spline": "a tone curve fitted to this camera",
    "linear": "no tone curve: display values are splatted as they are",
}
DESCRIPTIONS: dict[str, str] = {name: model.description for name, model in MODELS.items()}
# How sentences of the photometric selection begin (photometry/selection.py).
REASONS = ("Chosen:", "Simpler (", "Richer (", "What predicts best")


def count(number: float, one: str, many: str | None = None) -> str:
    """Return "1 view" or "1,200 views"."""
    noun = one if number == 1 else (many or one + "s")
    return f"{number:,.0f} {noun}"


def duration(seconds: float) -> str:
    """Return seconds in words, such as `5 min 12 s`."""
    whole = round(seconds)
    if whole < 100:
        return f"{seconds:.0f} s"
    minutes, rest = divmod(whole, 60)
    if minutes < 100:
        return f"{minutes} min {rest} s"
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min"


def seconds_of(run: RunFiles) -> float | None:
    """Return the seconds that the run took, or None where they are unknown."""
    return whole_run(run.part("seconds"))


def summary_sentences(run: RunFiles, scene: SceneMeasurements) -> list[str]:
    """Return three sentences: what was fitted, what was modelled, how good it is."""
    return [_what(run), _modelled(run), _how_good(run, scene)]


def _what(run: RunFiles) -> str:
    train, cameras = len(run.train), len(run.cameras)
    held_out = len(run.views) - train
    name = run.scene.name or "an unnamed scene"
    if not train:
        return f"A fit of {name} with the preset {run.preset}; it left no list of its views."
    by = f" by {count(cameras, 'camera')}" if cameras else ""
    decided = run.metrics.get("split")
    by_whom = f": {decided}" if isinstance(decided, str) else ""
    rest = f" ({held_out} more were held out{by_whom})" if held_out else ""
    gaussians = run.number("counts", "gaussians")
    made = "" if gaussians is None else f" with {count(gaussians, 'Gaussian')}"
    took = seconds_of(run)
    when = "" if took is None else f" in {duration(took)}"
    return f"{count(train, 'photograph')} of {name}{by}{rest} were fitted{made}{when}."


def _modelled(run: RunFiles) -> str:
    if run.photometry is None:
        return "What was modelled of the cameras is not known: photometry.json is missing."
    model, curve = run.photometry["model"], run.photometry["curve"].get("name", "")
    what = DESCRIPTIONS.get(model, model)
    if run.option("photometry", "appearance") == "ppisp":
        return (
            f"The preset {run.preset} learns cameras beside the splats: exposure and colours of "
            "every view, vignetting and response of every camera."
        )
    if curve == "linear" and model == "constant":
        return (
            f"The preset {run.preset} models no camera: display values are splatted as they are"
            f"{_correction(run)}."
        )
    span = exposure_span(run)
    spans = "" if span is None or model == "constant" else f"; exposures span {span:.1f} stops"
    curve = CURVES.get(curve, curve)
    return f"It models {what} under {curve}{_correction(run)}, {_why(run)}{spans}."


def _correction(run: RunFiles) -> str:
    kind = run.option("photometry", "appearance")
    kinds = {"affine": "a colour matrix", "bilateral": "a bilateral grid", "curve": "a curve"}
    kinds["luminance"] = "colour axes and an enhancing curve"
    return "" if kind is None else f", with {kinds.get(kind, kind)} learned for every view"


def _why(run: RunFiles) -> str:
    if any(r.startswith("Chosen:") for r in reasons(run)):
        return "the simplest choice that predicts held-out colours about as well as any"
    if run.option("photometry", "select"):
        return "as there were no shared points to choose by"
    return f"as the preset {run.preset} or the options say"


def _how_good(run: RunFiles, scene: SceneMeasurements) -> str:
    parts = []
    train = run.number("train", "psnr")
    held_out = run.number("test", "exposure_fitted", "psnr")
    if held_out is not None:
        against = "" if train is None else f" (training photographs at {train:.1f} dB)"
        parts.append(f"Held-out photographs are met at {held_out:.1f} dB{against}")
    elif train is not None:
        parts.append(f"Training photographs are met at {train:.1f} dB; none was held out")
    if scene.seams:
        before, after = seam_medians(scene)
        parts.append(
            f"neighbouring photographs differ by {before:.2f} stops as taken and by {after:.2f} "
            "developed alike"
        )
    error = true_error(run, scene)
    if error is not None:
        parts.append(f"exposures are within {error['ev']:.3f} stops (RMS) of the true ones")
    if not parts:
        return "How good it is cannot be said: metrics.json is missing."
    text = "; ".join(parts)
    return text[0].upper() + text[1:] + "."


def exposure_span(run: RunFiles) -> float | None:
    """Return the stops between the darkest and the brightest training exposure."""
    values = [v["exposure_ev"] for v in run.train if v["exposure_ev"] is not None]
    return max(values) - min(values) if values else None


def seam_medians(scene: SceneMeasurements) -> tuple[float, float]:
    """Return the median over pairs of the seams before and after, stops."""
    seams = [p.seam for p in scene.seams]
    return (
        float(np.median([s.before_ev for s in seams])),
        float(np.median([s.after_ev for s in seams])),
    )


def true_error(run: RunFiles, scene: SceneMeasurements) -> ExposureError | None:
    """Return the error of the exposures where the scene knows the true ones."""
    pairs = [
        (v["exposure"], scene.true_exposures[v["image"]])
        for v in run.train
        if v["exposure"] is not None and v["image"] in scene.true_exposures
    ]
    if len(pairs) < 2 or any(a <= 0 or b <= 0 for a, b in pairs):
        return None
    found, true = np.array(pairs).T
    return exposure_error(found, true)


def reasons(run: RunFiles) -> list[str]:
    """Return why the photometric model was chosen, in the fit's own words."""
    return [n for n in _notes(run) if n.startswith(REASONS)]


def remarks(run: RunFiles) -> list[str]:
    """Return all other notes of the fit."""
    return [n for n in _notes(run) if not n.startswith(REASONS)]


def _notes(run: RunFiles) -> list[str]:
    notes = run.metrics.get("notes")
    return [str(n) for n in notes] if isinstance(notes, list) else []


def against_exif(run: RunFiles) -> Agreement | None:
    """Return how the exposures agree with EXIF; None where fewer than two views carry it."""
    views = [v for v in run.train if v["exposure_ev"] is not None]
    if sum(v["exif_ev"] is not None for v in views) < 2:
        return None

    def column(values, missing: float) -> np.ndarray:
        return np.array([missing if v is None else v for v in values], float)

    found = column([v["exposure_ev"] for v in views], np.nan)
    errors = column([v.get("exposure_ev_error") for v in views], 0.0)
    return compare(found, errors, column([v["exif_ev"] for v in views], np.nan))


def scene_title(run: RunFiles) -> str:
    """Return the name of the run's scene, or else of its folder."""
    return run.scene.name or run.folder.resolve().name
