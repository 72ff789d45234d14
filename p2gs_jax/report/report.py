"""`report.html`: one run on one page."""

from __future__ import annotations

from pathlib import Path

from p2gs_jax.core.progress import Reporter, Silent
from p2gs_jax.report import run_summary
from p2gs_jax.report.drive_sections import (
    depth_section,
    novel_section,
    parts_section,
    unexplained_section,
)
from p2gs_jax.report.page import (
    Section,
    check_place,
    key_numbers,
    listed,
    made_by,
    page,
    paragraph,
    text,
    write_page,
)
from p2gs_jax.report.photometry_sections import camera_sections
from p2gs_jax.report.picture_sections import comparison_section, hdr_section, seam_section
from p2gs_jax.report.run_files import RunFiles, read_run
from p2gs_jax.report.run_sections import (
    configuration_section,
    score_section,
    timing_section,
    training_section,
)
from p2gs_jax.report.run_warnings import RunWarning, run_warnings
from p2gs_jax.report.scene_measurements import SceneMeasurements, measure_scene
from p2gs_jax.report.view_comparisons import held_out_comparisons

MOST_COMPARED = 6


def write_report(
    folder: str | Path,
    out: str | Path | None = None,
    *,
    scene: str | Path | None = None,
    render: bool = True,
    reporter: Reporter | None = None,
) -> Path:
    """Write one page about a run, which needs no other file and no network.

    Args:
        folder: the run folder.
        out: the page; None takes `report.html` in the folder.
        scene: where the run's scene lies now; None looks where it was.
        render: load the scene and render for the seams; False uses only what the folder holds.
        reporter: receives progress.

    Returns:
        The page.

    Raises:
        UserError: it is no run folder, or the page cannot be written.
    """
    reporter = reporter or Silent()
    folder = Path(folder)
    run = read_run(folder, None if scene is None else Path(scene))
    path = folder / "report.html" if out is None else Path(out)
    check_place(path)
    measured = measure_scene(run, reporter, render=render)
    reporter.stage("Drawing")
    write_page(path, report_page(run, measured))
    return path


def report_page(run: RunFiles, scene: SceneMeasurements) -> str:
    """Return the page of a run.

    Args:
        run: what its folder holds.
        scene: what was measured on its scene.
    """
    problems: list[str] = []
    comparisons = held_out_comparisons(run, MOST_COMPARED, problems) or list(scene.comparisons)
    found = run_warnings(run, scene)
    model, *camera = camera_sections(run, scene)
    unexplained = unexplained_section(run, problems)
    sections = [
        _warning_section(found, run, scene, problems),
        model,
        *camera,
        seam_section(scene),
        comparison_section(comparisons, len(run.held_out)),
        unexplained,
        hdr_section(run, comparisons),
        score_section(run),
        parts_section(run),
        depth_section(run),
        novel_section(run),
        training_section(run),
        timing_section(run),
        configuration_section(run),
    ]
    name = run_summary.scene_title(run)
    head = f"<h1>{text(name)}</h1>\n"
    head += paragraph(
        f"A fit with the preset {run.preset}, in {run.folder.resolve().name}/", "quiet"
    )
    head += "".join(
        paragraph(sentence, "lead") for sentence in run_summary.summary_sentences(run, scene)
    )
    head += key_numbers(_key_numbers(run, scene, found))
    return page(f"{name} · p2gs-jax", head, sections, made_by("report"))


def _key_numbers(
    run: RunFiles, scene: SceneMeasurements, found: list[RunWarning]
) -> list[tuple[str, str, str]]:
    out = []
    held_out = run.number("test", "exposure_fitted", "psnr")
    train = run.number("train", "psnr")
    if held_out is not None:
        out.append(("Held-out PSNR", f"{held_out:.1f} dB", "exposure fitted to each"))
    if train is not None:
        out.append(("Training PSNR", f"{train:.1f} dB", "own exposures"))
    span = run_summary.exposure_span(run)
    if span is not None:
        out.append(("Exposures span", f"{span:.1f}", "stops, training views"))
    error = run_summary.true_error(run, scene)
    if error is not None:
        out.append(("Exposure error", f"{error['ev']:.3f}", "stops RMS, truth known"))
    if scene.seams:
        before, after = run_summary.seam_medians(scene)
        pairs = run_summary.count(len(scene.seams), "pair")
        out.append(("Seams", f"{before:.2f} → {after:.2f}", f"stops, median of {pairs}"))
    gaussians = run.number("counts", "gaussians")
    if gaussians is not None:
        steps = run.number("counts", "steps")
        out.append(
            ("Gaussians", f"{gaussians:,.0f}", "" if steps is None else f"{steps:,.0f} steps")
        )
    seconds = run_summary.seconds_of(run)
    if seconds is not None:
        out.append(("Time", run_summary.duration(seconds), "in all"))
    out.append(("To watch", str(len(found)), "see below" if found else "nothing stands out"))
    return out


def _warning_section(
    found: list[RunWarning], run: RunFiles, scene: SceneMeasurements, problems: list[str]
) -> Section:
    if found:
        items = "".join(
            f"<li><p><strong>{text(c.title)}.</strong> {text(c.text)}</p></li>" for c in found
        )
        body = f'<ul class="warnings">{items}</ul>'
    else:
        body = paragraph("Nothing stands out.")
    missing = [*run.missing, *scene.missing, *problems]
    if missing:
        body += f"<h3>What this page lacks</h3>{listed(missing)}"
    said = run_summary.remarks(run)
    if said:
        body += f"<h3>What the fit remarked</h3>{listed(said)}"
    return Section("watch", "What to watch", body)
