"""Building blocks of the pages, each one HTML file without external resources."""

from __future__ import annotations

import html
import re
from collections.abc import Iterable, Sequence
from importlib import resources
from pathlib import Path

from p2gs_jax.core.atomic import write_text
from p2gs_jax.core.text import printable
from p2gs_jax.errors import UserError

# This policy stops the browser from loading anything from elsewhere, whatever the page contains.
POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"


def page(title: str, head: str, sections: Sequence[tuple[str, str, str]], foot: str) -> str:
    """Return the whole page; `head` and `foot` are HTML above and below the sections.

    A section has an anchor, a heading and HTML; sections without HTML are left out.
    """
    shown = [(key, text(heading), body) for key, heading, body in sections if body]
    parts = {
        "policy": POLICY,
        "title": text(title),
        "css": _read("page.css"),
        "head": head,
        "links": "".join(f'<a href="#{key}">{heading}</a>' for key, heading, _ in shown),
        "bodies": "\n".join(
            f'<section id="{key}">\n<h2>{heading}</h2>\n{body}\n</section>'
            for key, heading, body in shown
        ),
        "foot": foot,
    }
    # One pass replaces all placeholders, so that inserted text is never searched for them.
    return re.sub(r"\{\{(\w+)\}\}", lambda found: parts[found[1]], _read("page.html"))


def _read(name: str) -> str:
    return resources.files("p2gs_jax.report").joinpath(name).read_text(encoding="utf-8")


def check_place(path: Path) -> None:
    """Raise a UserError if the path is a folder or does not end in .html or .htm."""
    if path.suffix.lower() not in (".html", ".htm") or path.is_dir():
        fix = "name a file that ends in .html"
        raise UserError(f"{path} is not a valid name for a page.", fix=fix)


def write_page(path: Path, html_text: str) -> None:
    """Write a page; UserError: it cannot be written."""
    check_place(path)
    try:
        write_text(path, html_text)
    except OSError as error:
        fix = "name another file with --out"
        raise UserError(f"{path} cannot be written: {error.strerror or error}.", fix=fix) from error


def made_by(command: str) -> str:
    """Return the footer of a page."""
    from p2gs_jax import __version__

    return text(f"Made by p2gs-jax {command}, version {__version__}.")


def text(value: object) -> str:
    """Return a value as text escaped for HTML."""
    return html.escape(printable(str(value)), quote=True)


def paragraph(sentence: str, kind: str = "") -> str:
    """Return a paragraph of text; `kind` is its class in the style sheet."""
    attribute = f' class="{kind}"' if kind else ""
    return f"<p{attribute}>{text(sentence)}</p>"


def listed(sentences: Iterable[str]) -> str:
    """Return a list of sentences as HTML, or "" if there are none."""
    items = "".join(f"<li>{text(s)}</li>" for s in sentences)
    return f'<ul class="plain">{items}</ul>' if items else ""


def figure(content: str, caption: str) -> str:
    """Return a figure of HTML `content` with a caption (text)."""
    return f"<figure>\n{content}\n<figcaption>{text(caption)}</figcaption></figure>"


def row(cells: Sequence[tuple[str, str]], columns: str) -> str:
    """Return a row of pictures (HTML) with captions, which becomes a column on narrow screens.

    `columns`, the number of pictures side by side, is `two` or `three`.
    """
    inner = "".join(f"<div>{picture}<span>{text(under)}</span></div>" for picture, under in cells)
    return f'<div class="row {columns}">{inner}</div>'


def table(
    names: Sequence[str],
    rows: Sequence[Sequence[str]],
    *,
    numbers: Iterable[int] = (),
    tall: bool = False,
) -> str:
    """Return a table of text, with scroll bars if it is too wide or, with `tall`, too high.

    `numbers` holds the indices of columns with numbers.
    """
    numbers = set(numbers)

    def cells(values: Sequence[str], tag: str) -> str:
        kinds = ["n" * (i in numbers) for i in range(len(values))]
        each = zip(kinds, values, strict=True)
        inner = "".join(f'<{tag} class="{kind}">{text(v)}</{tag}>' for kind, v in each)
        return f"<tr>{inner}</tr>"

    body = "\n".join(cells(values, "td") for values in rows)
    return (
        f'<div class="scroll{" tall" * tall}" tabindex="0"><table>\n'
        f"<thead>{cells(names, 'th')}</thead>\n<tbody>\n{body}\n</tbody></table></div>"
    )


def key_numbers(items: Sequence[tuple[str, str, str]]) -> str:
    """Return the key numbers at the top of a page from their names, values and remarks."""
    inner = "".join(
        f"<div><dt>{text(name)}</dt><dd>{text(value)}<small>{text(remark)}</small></dd></div>"
        for name, value, remark in items
    )
    return f'<dl class="key">{inner}</dl>' if inner else ""


def folded(title: str, content: str) -> str:
    """Return HTML `content` under a title that unfolds it."""
    return f"<details><summary>{text(title)}</summary>{content}</details>"
