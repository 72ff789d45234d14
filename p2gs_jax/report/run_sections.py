"""Sections on the run itself: scores, training, timings, configuration."""

from __future__ import annotations

import itertools
import json
from typing import Any

import numpy as np

from p2gs_jax.config import preset, to_dict
from p2gs_jax.errors import UserError
from p2gs_jax.report import run_summary
from p2gs_jax.report.page import Section, figure, folded, paragraph, table, text
from p2gs_jax.report.run_charts import Training, training_chart
from p2gs_jax.report.run_files import RunFiles, number_at

MOST_TERMS = 3
PROTOCOLS = (
    ("training", "own exposure and gamma", ("train",)),
    ("training", "mean exposure and gamma", ("train", "averaged")),
    ("held out", "mean exposure and gamma", ("test", "averaged")),
    ("held out", "exposure fitted to each photograph", ("test", "exposure_fitted")),
    (
        "held out",
        "all that varies per view fitted to each photograph",
        ("test", "photometry_fitted"),
    ),
    ("held out", "exposure metered, as the camera would", ("test", "metered")),
    ("all", "reference photographs, mean exposure", ("reference", "averaged")),
    ("all", "reference photographs, geometric mean exposure", ("reference", "geometric")),
    ("all", "reference photographs, one scale for all", ("reference", "scale_aligned")),
    (
        "held out",
        "reference photographs, one scale for all",
        ("reference", "scale_aligned", "test"),
    ),
)
VIDEOS = (
    ("photographs", "photographs"),
    ("per_view", "renders, own exposures"),
    ("averaged", "renders, mean exposure"),
)


def score_section(run: RunFiles) -> Section:
    """Every score, by protocol."""
    rows = []
    for views, protocol, path in PROTOCOLS:
        values = [run.number(*path, name) for name in ("psnr", "ssim", "lpips")]
        if values[0] is not None or values[1] is not None:
            rows.append(
                [views, protocol, *(_shown(v, d) for v, d in zip(values, (2, 4, 4), strict=True))]
            )
    body = ""
    if rows:
        names = ["views", "shown with", "PSNR, dB", "SSIM", "LPIPS"]
        if not any(r[-1] for r in rows):
            names, rows = names[:-1], [r[:-1] for r in rows]
        body += table(names, rows, numbers=range(2, len(names)))
    body += _radiance(run) + _steadiness(run)
    return Section("scores", "Scores", body)


def _shown(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def _radiance(run: RunFiles) -> str:
    median, rms = (run.number("radiance", name) for name in ("stops_median", "stops_rms"))
    if median is None or rms is None:
        return ""
    said = (
        f"Against the scene's true radiance, after one common scale: {median:.3f} stops median, "
        f"{rms:.3f} RMS"
    )
    rest = [
        ("pu21_psnr", "PU21 PSNR {:.2f} dB"),
        ("pu21_ssim", "PU21 SSIM {:.4f}"),
        ("delta_e_itp", "colour difference {:.1f} ΔE ITP"),
        ("mu_law_psnr", "mu-law PSNR {:.2f} dB"),
    ]
    for name, form in rest:
        value = run.number("radiance", name)
        said += "" if value is None else "; " + form.format(value)
    return paragraph(said + ".")


def _steadiness(run: RunFiles) -> str:
    rows = []
    for key, name in VIDEOS:
        values = [run.number("consistency", key, n) for n in ("his", "std_luminance_relative")]
        if values[0] is not None:
            rows.append([name, *(_shown(v, 3) for v in values)])
    if not rows:
        return ""
    return (
        "<h3>Steadiness of the views played as a video</h3>"
        + table(["video", "HIS", "brightness, deviation"], rows, numbers=(1, 2))
        + paragraph(
            "HIS: change of exposure-free radiance from frame to frame, relative; deviation: of "
            "the mean brightness of the frames, relative. Both contain the scene's own motion, so "
            "compare them with the photographs'; lower is steadier.",
            "note",
        )
    )


def training_section(run: RunFiles) -> Section:
    """Loss, PSNR and Gaussians over the steps."""
    log = [r for r in run.log if number_at(r, "gaussians") is not None]
    if len(log) < 2:
        said = [m for m in run.missing if m.startswith("The training curves")]
        return Section("training", "Training", "".join(paragraph(m) for m in said))

    def column(*path: str) -> np.ndarray:
        return np.array([np.nan if (v := number_at(r, *path)) is None else v for r in log])

    losses = {"loss": column("loss")}
    terms = sorted({name for r in log for name in r.get("terms") or {}})
    values = {name: column("terms", name) for name in terms}
    ranked = sorted(
        (n for n in terms if np.isfinite(values[n]).any()), key=lambda n: -np.nanmedian(values[n])
    )
    losses |= {n.replace("_", " "): values[n] for n in ranked[:MOST_TERMS]}
    losses = {n: np.where(v > 0, v, np.nan) for n, v in losses.items()}
    training = Training(
        column("step"), column("psnr"), losses, column("gaussians"), tuple(_marks(run, log))
    )
    chart = training_chart(training, label="PSNR, loss and Gaussians over the steps of the run")
    marks = "; ".join(f"{what} from step {at:.0f}" for at, what in training.marks)
    said = (
        "From log.jsonl; lines are running medians, the pale one is each entry. Entries average a "
        "few training views, so they scatter with how hard these are."
    )
    if marks:
        said += f" Dotted: {marks}."
    seconds = number_at(log[-1], "seconds")
    if seconds is not None:
        said += f" The last step came after {run_summary.duration(seconds)}."
    return Section("training", "Training", figure(chart, said))


def _marks(run: RunFiles, log: list[dict[str, Any]]) -> list[tuple[float, str]]:
    """Return the steps at which images grow and exposures begin to move."""
    out = []
    for before, now in itertools.pairwise(log):
        a, b = number_at(before, "shrink"), number_at(now, "shrink")
        if a is not None and b is not None and a != b:
            size = "full-size images" if b == 1 else f"images at 1/{b:.0f}"
            out.append((number_at(now, "step") or 0.0, size))
    freeze = run.option("photometry", "freeze_until")
    solved = any(v.get("exposure_ev_error") is not None for v in run.train)
    if isinstance(freeze, int | float) and 0 < freeze < 1 and solved:
        later = [r for r in log if (number_at(r, "progress") or 0) >= freeze]
        if later:
            out.append((number_at(later[0], "step") or 0.0, "exposures move"))
    return sorted(out)


def timing_section(run: RunFiles) -> Section:
    """Where the time went."""
    before, optimisation = (
        run.number("seconds", name) for name in ("total_until_evaluation", "optimisation")
    )
    after = run.number("seconds", "evaluation_and_files")
    rows = []
    if before is not None and optimisation is not None and before >= optimisation:
        rows.append(["Reading, exposures, seeds", run_summary.duration(before - optimisation)])
    if optimisation is not None:
        rows.append(["Optimisation, with compiling", run_summary.duration(optimisation)])
    if after is not None:
        rows.append(["Judging and writing files", run_summary.duration(after)])
    total = run_summary.seconds_of(run)
    if total is not None:
        rows.append(["In all", run_summary.duration(total)])
    step = run.number("seconds_per_step")
    steps = run.number("counts", "steps")
    if step is not None and steps is not None:
        rows.append(["Steps", f"{steps:,.0f}, {1e3 * step:.0f} ms each"])
    counts = run.part("counts")
    for key, name in (
        ("seed_points", "Seed points"),
        ("gaussians", "Gaussians"),
        ("refused_densifications", "Gaussians that found no room"),
        ("tile_lists_grown", "Times a tile list grew"),
    ):
        value = number_at(counts, key)
        if value is not None:
            rows.append([name, f"{value:,.0f}"])
    if not rows:
        return Section("timings", "Timings and counts", "")
    return Section("timings", "Timings and counts", table(["", ""], rows, numbers=(1,)))


def configuration_section(run: RunFiles) -> Section:
    """The options, first those that differ from the preset's."""
    if not run.options:
        return Section("configuration", "Configuration", "")
    given = flat(run.options)
    try:
        base = flat(to_dict(preset(run.preset)))  # pyright: ignore[reportArgumentType]
    except UserError:
        base = {}
    differs = [
        [name, option_text(value), option_text(base[name]) if name in base else ""]
        for name, value in given.items()
        if option_text(value) != option_text(base.get(name))
    ]
    body = paragraph(f"Preset {run.preset}. Scene: {run.scene}.")
    if differs and base:
        body += table(["option", "here", "in the preset"], differs)
    elif base:
        body += paragraph("All options are the preset's.")
    dump = text(json.dumps(run.options, indent=2))
    body += folded("The whole configuration (config.json)", f'<pre tabindex="0">{dump}</pre>')
    return Section("configuration", "Configuration", body)


def flat(options: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested options by dotted names."""
    out: dict[str, Any] = {}
    for name, value in options.items():
        if isinstance(value, dict):
            out |= flat(value, f"{prefix}{name}.")
        else:
            out[prefix + name] = value
    return out


def option_text(value: Any) -> str:
    """Return the value of an option as people write it."""
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(option_text, value)) + "]"
    return "none" if value is None else str(value)
