"""The documentation site: pages from outside docs/, and links that work there as on GitHub.

Pages and pictures keep their places in the repository; on the site, files from outside docs/ lie
under project/. Links are written as the repository needs them and rewritten here. A link to a file
or folder that the site does not show becomes plain text; one that leads nowhere is left, and
`mkdocs build --strict` refuses it.
"""

from __future__ import annotations

import posixpath
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[1]
DOCS, PROJECT = "docs/", "project/"
OUTSIDE = (
    "README.md",
    "CHANGELOG.md",
    "CONTRIBUTING.md",
    "experiments/README.md",
    "experiments/RESULTS.md",
    "experiments/PUBLISHED.md",
    "experiments/published/README.md",
    *sorted(p.relative_to(ROOT).as_posix() for p in (ROOT / "experiments/results").glob("*.md")),
)
FENCED = re.compile(r"(^```.*?^```)", re.M | re.S)
LINK = re.compile(r"(!?)\[([^\]]*)\]\((?!https?:|mailto:|#)([^)\s#]+)(#[^)\s]*)?\)")
LIST_AFTER_PROSE = re.compile(r"^(?![-*+] |\d+\. |[\s|]|$)(.+)\n(?=(?:[-*+]|\d+\.) )", re.M)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that lie outside docs/, and the pictures that they show."""
    for page in OUTSIDE:
        text = (ROOT / page).read_text(encoding="utf-8")
        files.append(File.generated(config, PROJECT + page, content=text))
        for picture, _, target, _ in LINK.findall(text):
            path = _in_repository(page, target)
            if picture and not path.startswith(DOCS) and PROJECT + path not in files.src_uris:
                source = str(ROOT / path)
                files.append(File.generated(config, PROJECT + path, abs_src_path=source))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Point links at the site's pages; add the blank line that MkDocs needs before a list."""
    uri = page.file.src_uri
    at = uri.removeprefix(PROJECT) if uri.startswith(PROJECT) else DOCS + uri

    def moved(match: re.Match) -> str:
        picture, text, target, anchor = match.groups("")
        path = _in_repository(at, target)
        place = path.removeprefix(DOCS) if path.startswith(DOCS) else PROJECT + path
        if place in files.src_uris:
            link = posixpath.relpath(place, posixpath.dirname(uri) or ".")
            return f"{picture}[{text}]({link}{anchor})"
        return text if (ROOT / path).exists() else match[0]

    parts = FENCED.split(markdown)
    parts[::2] = [LIST_AFTER_PROSE.sub(r"\1\n\n", LINK.sub(moved, part)) for part in parts[::2]]
    return "".join(parts)


def _in_repository(page: str, target: str) -> str:
    """Return the target of a page's link as a path from the repository's root."""
    return posixpath.normpath(posixpath.join(posixpath.dirname(page), target))
