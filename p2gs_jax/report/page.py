"""Building blocks of the pages: one HTML file each, without external resources."""

from __future__ import annotations

import html
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib import resources
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from p2gs_jax.core.atomic import write_text
from p2gs_jax.errors import UserError

# The browser loads nothing from elsewhere, whatever the page contains.
POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"


@dataclass(frozen=True)
class Section:
    """Part of a page.

    Attributes:
        key: its anchor.
        title: its heading.
        body: HTML.
    """

    key: str
    title: str
    body: str


def page(title: str, head: str, sections: Sequence[Section], foot: str) -> str:
    """Return the whole page.

    Args:
        title: of the window; text.
        head: HTML above the sections.
        sections: in order; empty ones are left out.
        foot: HTML below them.
    """
    css = resources.files("p2gs_jax.report").joinpath("page.css").read_text(encoding="utf-8")
    shown = [s for s in sections if s.body]
    links = "".join(f'<a href="#{s.key}">{text(s.title)}</a>' for s in shown)
    bodies = "\n".join(
        f'<section id="{s.key}">\n<h2>{text(s.title)}</h2>\n{s.body}\n</section>' for s in shown
    )
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{POLICY}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<link rel="icon" href="data:,">
<title>{text(title)}</title>
<style>
{css}</style>
</head>
<body>
<div class="sheet">
<header>
{head}
<nav aria-label="Sections">{links}</nav>
</header>
<main>
{bodies}
</main>
<footer>{foot}</footer>
</div>
</body>
</html>
"""


def check_place(path: Path) -> None:
    """Check the name of a page before any work is done.

    Raises:
        UserError: it is a folder, or does not end in .html.
    """
    if path.suffix.lower() not in (".html", ".htm") or path.is_dir():
        raise UserError(f"{path} is no name of a page.", fix="name a file that ends in .html")


def write_page(path: Path, html_text: str) -> None:
    """Write a page.

    Raises:
        UserError: the file cannot be written, or does not end in .html.
    """
    check_place(path)
    try:
        write_text(path, html_text)
    except OSError as error:
        raise UserError(
            f"{path} cannot be written: {error.strerror or error}.",
            fix="name another place with --out",
        ) from error


def made_by(command: str) -> str:
    """Return the foot of a page."""
    try:
        number = version("p2gs-jax")
    except PackageNotFoundError:
        number = ""
    return text(f"Made by p2gs-jax {command}, version {number or 'unknown'}.")


def text(value: object) -> str:
    """Return text as HTML."""
    return html.escape(str(value), quote=True)


def paragraph(sentence: str, kind: str = "") -> str:
    """Return a paragraph of text."""
    of = f' class="{kind}"' if kind else ""
    return f"<p{of}>{text(sentence)}</p>"


def listed(sentences: Iterable[str]) -> str:
    """Return a list of sentences; empty where there are none."""
    items = "".join(f"<li>{text(s)}</li>" for s in sentences)
    return f'<ul class="plain">{items}</ul>' if items else ""


def figure(content: str, caption: str = "") -> str:
    """Return a figure.

    Args:
        content: HTML.
        caption: text.
    """
    said = f"<figcaption>{text(caption)}</figcaption>" if caption else ""
    return f"<figure>\n{content}\n{said}</figure>"


def row(cells: Sequence[tuple[str, str]], columns: str) -> str:
    """Return pictures beside each other; above each other on narrow screens.

    Args:
        cells: picture as HTML, and its caption.
        columns: `two`, `three`, or `many` where there may be more.
    """
    inner = "".join(f"<div>{picture}<span>{text(said)}</span></div>" for picture, said in cells)
    return f'<div class="row {columns}">{inner}</div>'


def table(
    names: Sequence[str],
    rows: Sequence[Sequence[str]],
    *,
    numbers: Iterable[int] = (),
    tall: bool = False,
) -> str:
    """Return a table, with a scroll bar of its own where it is too wide.

    Args:
        names: of the columns.
        rows: text of the cells.
        numbers: columns that are numbers.
        tall: scroll vertically as well.
    """
    of = [' class="n"' if i in set(numbers) else "" for i in range(len(names))]

    def cells(values: Sequence[str], kind: str) -> str:
        return "".join(f"<{kind}{o}>{text(v)}</{kind}>" for o, v in zip(of, values, strict=True))

    body = "\n".join(f"<tr>{cells(values, 'td')}</tr>" for values in rows)
    scroll = "scroll tall" if tall else "scroll"
    return (
        f'<div class="{scroll}" tabindex="0"><table>\n'
        f"<thead><tr>{cells(names, 'th')}</tr></thead>\n<tbody>\n{body}\n</tbody></table></div>"
    )


def key_numbers(items: Sequence[tuple[str, str, str]]) -> str:
    """Return the key numbers at the top of a page.

    Args:
        items: name, value, and a remark.
    """
    inner = "".join(
        f"<div><dt>{text(name)}</dt><dd>{text(value)}<small>{text(remark)}</small></dd></div>"
        for name, value, remark in items
    )
    return f'<dl class="key">{inner}</dl>' if inner else ""


def folded(title: str, content: str) -> str:
    """Return collapsed content with a title."""
    return f"<details><summary>{text(title)}</summary>{content}</details>"
