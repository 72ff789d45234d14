"""`report.html`: one run on one page."""

from __future__ import annotations

from pathlib import Path

from p2gs_jax.core.progress import Reporter, Silent
from p2gs_jax.report import words
from p2gs_jax.report.cautions import Caution, cautions
from p2gs_jax.report.from_scene import FromScene, ask_scene
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
from p2gs_jax.report.picture_sections import hdr_section, seam_section, strip_section
from p2gs_jax.report.run_files import RunFiles, read_run
from p2gs_jax.report.run_sections import (
    configuration_section,
    score_section,
    timing_section,
    training_section,
)
from p2gs_jax.report.strips import held_out_strips

MOST_STRIPS = 6


def write_report(
    folder: str | Path,
    out: str | Path | None = None,
    *,
    scene: str | Path | None = None,
    render: bool = True,
    reporter: Reporter | None = None,
) -> Path:
    """Explain a run on one page, which needs no other file and no network.

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
    told = ask_scene(run, reporter, render=render)
    reporter.stage("Drawing")
    write_page(path, report_page(run, told))
    return path


def report_page(run: RunFiles, scene: FromScene) -> str:
    """Return the page of a run.

    Args:
        run: what its folder holds.
        scene: what its scene told.
    """
    problems: list[str] = []
    strips = held_out_strips(run, MOST_STRIPS, problems) or list(scene.strips)
    found = cautions(run, scene)
    model, *camera = camera_sections(run, scene)
    sections = [
        _caution_section(found, run, scene, problems),
        model,
        *camera,
        seam_section(scene),
        strip_section(strips, len(run.held_out)),
        hdr_section(run, strips),
        score_section(run),
        training_section(run),
        timing_section(run),
        configuration_section(run),
    ]
    name = words.scene_title(run)
    head = f"<h1>{text(name)}</h1>\n"
    head += paragraph(
        f"A fit with the preset {run.preset}, in {run.folder.resolve().name}/", "quiet"
    )
    head += "".join(paragraph(sentence, "lead") for sentence in words.summary(run, scene))
    head += key_numbers(_key_numbers(run, scene, found))
    return page(f"{name} · p2gs-jax", head, sections, made_by("report"))


def _key_numbers(
    run: RunFiles, scene: FromScene, found: list[Caution]
) -> list[tuple[str, str, str]]:
    out = []
    held_out = run.number("test", "exposure_fitted", "psnr")
    train = run.number("train", "psnr")
    if held_out is not None:
        out.append(("Held-out PSNR", f"{held_out:.1f} dB", "exposure fitted to each"))
    if train is not None:
        out.append(("Training PSNR", f"{train:.1f} dB", "own exposures"))
    span = words.exposure_span(run)
    if span is not None:
        out.append(("Exposures span", f"{span:.1f}", "stops, training views"))
    error = words.true_error(run, scene)
    if error is not None:
        out.append(("Exposure error", f"{error['ev']:.3f}", "stops RMS, truth known"))
    if scene.seams:
        before, after = words.seam_medians(scene)
        pairs = words.count(len(scene.seams), "pair")
        out.append(("Seams", f"{before:.2f} → {after:.2f}", f"stops, median of {pairs}"))
    gaussians = run.number("counts", "gaussians")
    if gaussians is not None:
        steps = run.number("counts", "steps")
        out.append(
            ("Gaussians", f"{gaussians:,.0f}", "" if steps is None else f"{steps:,.0f} steps")
        )
    seconds = words.seconds_of(run)
    if seconds is not None:
        out.append(("Time", words.duration(seconds), "in all"))
    out.append(("To watch", str(len(found)), "see below" if found else "nothing stands out"))
    return out


def _caution_section(
    found: list[Caution], run: RunFiles, scene: FromScene, problems: list[str]
) -> Section:
    if found:
        items = "".join(
            f"<li><p><strong>{text(c.title)}.</strong> {text(c.text)}</p></li>" for c in found
        )
        body = f'<ul class="cautions">{items}</ul>'
    else:
        body = paragraph("Nothing stands out.")
    missing = [*run.missing, *scene.missing, *problems]
    if missing:
        body += f"<h3>What this page lacks</h3>{listed(missing)}"
    said = words.remarks(run)
    if said:
        body += f"<h3>What the fit remarked</h3>{listed(said)}"
    return Section("watch", "What to watch", body)
