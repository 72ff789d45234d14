"""Sections on drives."""

from __future__ import annotations

from p2gs_jax.errors import UserError
from p2gs_jax.report.page import Section, folded, paragraph, row, table
from p2gs_jax.report.pictures import jpeg
from p2gs_jax.report.run_files import RunFiles, number_at
from p2gs_jax.report.view_comparisons import read_png
from p2gs_jax.run.layout import RunFolder


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
    folder = RunFolder(run.folder).unexplained
    cells = []
    by_view = run.part("unexplained", "per_view")
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
    return Section("unexplained", title, body)
