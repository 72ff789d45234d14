"""Sections on drives."""

from __future__ import annotations

from pathlib import Path

from p2gs_jax.errors import UserError
from p2gs_jax.report.page import Section, folded, paragraph, row, table
from p2gs_jax.report.pictures import jpeg
from p2gs_jax.report.run_files import RunFiles, number_at
from p2gs_jax.report.view_comparisons import read_png
from p2gs_jax.run.folder import RunFolder

PROTOCOLS = (
    ("training", "own exposure and gamma", ("train",)),
    ("held out", "mean exposure and gamma", ("test", "averaged")),
    ("held out", "exposure fitted to each photograph", ("test", "exposure_fitted")),
    ("held out", "exposure metered, as the camera would", ("test", "metered")),
)
PARTS = (("whole", "all"), ("static", "what stands"), ("moving", "what moves"))
SPLITS = (("all", "all"), ("held_out", "held out"))


def parts_section(run: RunFiles) -> Section:
    """Scores over static pixels and over those of moving objects."""
    title = "What stands, and what moves"
    rows = []
    for views, protocol, path in PROTOCOLS:
        for part, said in PARTS:
            values = [run.number(*path, part, name) for name in ("psnr", "ssim", "lpips")]
            count = run.number(*path, part, "views")
            if values[0] is not None and count is not None:
                digits = zip(values, (2, 4, 4), strict=True)
                scores = ["" if v is None else f"{v:.{d}f}" for v, d in digits]
                rows.append([views, protocol, said, *scores, f"{count:.0f}"])
    if not rows:
        return Section("parts", title, "")
    names = ["views", "shown with", "pixels", "PSNR, dB", "SSIM", "LPIPS", "views that show any"]
    if not any(r[5] for r in rows):
        names, rows = names[:5] + names[6:], [r[:5] + r[6:] for r in rows]
    said = (
        "Moving: within the boxes of what moves at some time. SSIM is the mean of the whole "
        "image's map over the part."
    )
    return Section(
        "parts", title, table(names, rows, numbers=range(3, len(names))) + paragraph(said, "note")
    )


def depth_section(run: RunFiles) -> Section:
    """Rendered depth against LiDAR."""
    title = "Depth against LiDAR"
    rows = []
    for split, views in SPLITS:
        for part, said in PARTS[1:]:
            at = ("depth", split, part)
            values = [run.number(*at, name) for name in DEPTH]
            points = run.number(*at, "points")
            if points is not None:
                shown = [_depth(n, v) for n, v in zip(DEPTH, values, strict=True)]
                rows.append([views, said, *shown, f"{points:,.0f}"])
    if not rows:
        return Section("depth", title, "")
    names = ["views", "points", "median error", "relative", "within 10 %", "no surface", "count"]
    said = (
        "Rendered depth at the points of the sweep nearest in time to each view, without those "
        "that nearer points hide; points on moving boxes are carried to the time of the view. "
        "Where the render shows no surface, the error counts as infinite."
    )
    body = table(names, rows, numbers=range(2, len(names))) + paragraph(said, "note")
    return Section("depth", title, body)


DEPTH = ("median_m", "median_relative", "within_10_percent", "missing")


def _depth(name: str, value: float | None) -> str:
    if value is None:  # infinite: more than half of the points have no surface
        return "none"
    return f"{value:.2f} m" if name == "median_m" else f"{value:.1%}"


def novel_section(run: RunFiles) -> Section:
    """Views from beside the way."""
    title = "From beside the way"
    found = run.metrics.get("novel_views")
    if not isinstance(found, list) or not found:
        return Section("novel", title, "")
    rows, with_depth = [], False
    for item in sorted(found, key=lambda i: -(number_at(i, "shift_m") or 0.0)):
        metres, unseen = number_at(item, "shift_m"), number_at(item, "unseen")
        if metres is None or unseen is None:
            continue
        points = number_at(item, "depth", "static", "points")
        depth = ["", ""]
        if points is not None:
            with_depth = True
            names = ("median_m", "within_10_percent")
            depth = [_depth(n, number_at(item, "depth", "static", n)) for n in names]
        side = "left" if metres > 0 else "right"
        rows.append([f"{abs(metres):g} m to the {side}", f"{unseen:.1%}", *depth])
    names = ["camera", "pixels that no training view shows"]
    names += ["median depth error", "depth within 10 %"] if with_depth else []
    rows = rows if with_depth else [r[:2] for r in rows]
    said = (
        "Some views moved sideways, seen from the driving direction. There are no photographs to "
        "compare with: the first number is what must be invented there, by the rendered depth; "
        "depth is held against LiDAR as above, what stands only."
    )
    body = table(names, rows, numbers=range(1, len(names))) + paragraph(said, "note")
    return Section("novel", title, body)


def unexplained_section(run: RunFiles, problems: list[str]) -> Section:
    """Pixels of training views that no static scene explains.

    Args:
        run: the folder.
        problems: receives a sentence for every picture that could not be read.
    """
    title = "What no static scene explains"
    share = run.number("unexplained", "share")
    if share is None:
        return Section("unexplained", title, "")
    body = paragraph(
        f"On average {share:.1%} of the pixels of a training view differ from its render by far "
        "more than the noise of that view, and more than the same surfaces do at other times. "
        "That is what moves where nothing follows it, its shadow and its mirror image."
    )
    body += _marked(run, "unexplained", RunFolder(run.folder).unexplained, problems)
    return Section("unexplained", title, body)


def _marked(run: RunFiles, key: str, folder: Path, problems: list[str]) -> str:
    """Return the photographs of a folder with pixels marked, and the share of every view."""
    cells, body = [], ""
    by_view = run.part(key, "per_view")
    shares = {name: number_at(by_view, name) or 0.0 for name in by_view}
    for path in sorted(folder.rglob("*.png")):
        name = path.relative_to(folder).with_suffix("").as_posix()
        try:
            picture = jpeg(read_png(path), f"{name} with what is unexplained marked")
        except UserError as error:
            problems.append(f"{name} is not shown: {error.message}.")
            continue
        found = [s for view, s in shares.items() if view.rsplit(".", 1)[0] == name]
        cells.append((picture, f"{name}: {found[0]:.1%}" if found else name))
    for k in range(0, len(cells), 2):
        body += row(cells[k : k + 2], "two")
    rows = [[view, f"{s:.2%}"] for view, s in sorted(shares.items(), key=lambda item: -item[1])]
    if rows:
        body += folded(
            "Every training view", table(["view", "share"], rows, numbers=(1,), tall=True)
        )
    return body
