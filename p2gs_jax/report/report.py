"""`report.html`: one run on one page."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from p2gs_jax.core.clock import whole_run
from p2gs_jax.core.progress import Reporter, Silent
from p2gs_jax.core.text import count_of
from p2gs_jax.evaluation.alignment import error_of_views
from p2gs_jax.report import findings, measurements, pictures
from p2gs_jax.report import page as html
from p2gs_jax.report import photometry_sections as photometry
from p2gs_jax.report import run_sections as sections
from p2gs_jax.report.findings import RunWarning, duration, run_warnings
from p2gs_jax.report.measurements import SceneMeasurements
from p2gs_jax.report.page import check_place, listed, page, paragraph, text
from p2gs_jax.report.run_files import RunFiles, read_run


def write_report(
    folder: str | Path,
    out: str | Path | None = None,
    *,
    scene: str | Path | None = None,
    render: bool = True,
    reporter: Reporter | None = None,
) -> Path:
    """Write one page about a run, which needs no other file and no network; return its path.

    The page is `out`, by default `report.html` in the folder. `scene` is the scene's current folder
    (None: as in the run). Without `render` the page has no seams, and only true exposures come from
    the scene. Raises UserError: the folder has no run, or the page cannot be written.
    """
    reporter = reporter or Silent()
    folder = Path(folder)
    run = read_run(folder, None if scene is None else Path(scene))
    path = folder / "report.html" if out is None else Path(out)
    check_place(path)
    measured = measurements.measure_scene(run, reporter, render=render)
    reporter.stage("Drawing")
    html.write_page(path, report_page(run, measured))
    return path


def report_page(run: RunFiles, measured: SceneMeasurements) -> str:
    """Return the page of a run from the files of its folder and measurements on its scene."""
    problems: list[str] = []
    truth = measured.true_exposures
    views = pictures.held_out_section(run, problems)
    found = run_warnings(run)
    shown = [
        ("warnings", "Warnings", _warnings(found, run, [*measured.missing, *problems])),
        ("model", "Photometric model", photometry.model_section(run)),
        ("exposures", "Exposures", photometry.exposure_section(run, truth)),
        ("white-balance", "White balance", photometry.white_balance_section(run)),
        ("response", "Tone curve", photometry.response_section(run)),
        ("vignetting", "Vignetting", photometry.vignetting_section(run)),
        ("seams", "Seams between photographs", measurements.seam_section(measured)),
        ("views", "Held-out views", views),
        ("scores", "Scores", sections.score_section(run)),
        ("parts", "Static and moving pixels", sections.parts_section(run)),
        ("depth", "Depth against LiDAR", sections.depth_section(run)),
        ("training", "Training", sections.training_section(run)),
        ("configuration", "Configuration", sections.configuration_section(run)),
    ]
    folder = run.folder.resolve().name
    name, under = run.scene.name or folder, f"A fit with the preset {run.preset}, in {folder}/"
    head = f"<h1>{text(name)}</h1>\n{paragraph(under, 'quiet')}"
    head += paragraph(findings.modelled(run), "lead")
    head += html.key_numbers(list(_key_numbers(run, measured, found)))
    return page(f"{name} · p2gs-jax", head, shown, html.made_by("report"))


def _key_numbers(
    run: RunFiles, measured: SceneMeasurements, found: list[RunWarning]
) -> Iterator[tuple[str, str, str]]:
    held_out, train = run.number("test", "exposure_fitted", "psnr"), run.number("train", "psnr")
    error = error_of_views(run.train, measured.true_exposures)
    for name, value, form, remark in (
        ("Held-out PSNR", held_out, "{:.1f} dB", "with the exposure fitted to each view"),
        ("Training PSNR", train, "{:.1f} dB", "with the exposure of each view"),
        ("Exposure range", findings.exposure_span(run), "{:.1f} stops", "of the training views"),
        ("Exposure error", error and error["ev"], "{:.3f} stops", "RMS against true exposures"),
    ):
        if value is not None:
            yield name, form.format(value), remark
    if measured.seams:
        before, after = measurements.seam_medians(measured.seams.values())
        pairs = count_of(len(measured.seams), "pair")
        yield "Seams", f"{before:.2f} → {after:.2f} stops", f"before and after, median of {pairs}"
    gaussians, steps = run.number("counts", "gaussians"), run.number("counts", "steps")
    if gaussians is not None:
        yield "Gaussians", f"{gaussians:,.0f}", "" if steps is None else f"{steps:,.0f} steps"
    seconds = whole_run(run.part("seconds"))
    if seconds is not None:
        yield "Time", duration(seconds), "for the whole run"
    yield "Warnings", str(len(found)), "listed below" if found else "no check found a problem"


def _warnings(found: list[RunWarning], run: RunFiles, missing: list[str]) -> str:
    items = "".join(
        f"<li><p><strong>{text(c.title)}.</strong> {text(c.text)}</p></li>" for c in found
    )
    body = f'<ul class="warnings">{items}</ul>' if found else paragraph("There are no warnings.")
    if run.missing or missing:
        body += f"<h3>Missing parts of this page</h3>{listed([*run.missing, *missing])}"
    return body
