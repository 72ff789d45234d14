"""Reading the documentation: its code blocks, what is said about testing them, and its links.

A block is tested by its language. What a reader need not see stands in comments right above it:

    <!-- test: skip (why) -->               it cannot run here
    <!-- test: run -->                      run these commands (sh), not only parse them
    <!-- test: write "300.0" as "2.0" -->   so that it ends soon; any number of these
"""

from __future__ import annotations

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
OUTSIDE = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")]
PAGES = sorted([*OUTSIDE, *(ROOT / "docs").rglob("*.md")])
LANGUAGES = ("python", "sh", "toml", "json", "text", "")

DIRECTIVE = re.compile(r"<!-- test: (.*?) -->")
WRITE = re.compile(r'write "(.*)" as "(.*)"')
SKIP = re.compile(r"skip \((.+)\)")
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")


@dataclass(frozen=True)
class Block:
    """A code block.

    Attributes:
        page: the file.
        line: of its first line of code.
        language: as it is named.
        code: with replacements made.
        skip: why it is not tested, or None.
        run: whether its commands are run.
    """

    page: Path
    line: int
    language: str
    code: str
    skip: str | None = None
    run: bool = False

    @property
    def name(self) -> str:
        return f"{self.page.relative_to(ROOT)}:{self.line}"


def blocks(page: Path) -> list[Block]:
    """Return the code blocks of a page.

    Raises:
        ValueError: a fence stays open, or a directive cannot be understood.
    """
    found, said, inside = [], [], None
    for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), 1):
        if inside is not None:
            if line.strip() == "```":
                found.append(_block(page, *inside, said))
                inside, said = None, []
            else:
                inside[2].append(line)
        elif line.startswith("```"):
            inside = (number + 1, line[3:].strip(), [])
        elif said_here := DIRECTIVE.findall(line):
            said += said_here
        elif line.strip() and said:
            raise ValueError(f"{page}:{number}: a test directive must stand above a code block")
    if inside is not None:
        raise ValueError(f"{page}: the code block of line {inside[0]} stays open")
    return found


def _block(page: Path, line: int, language: str, lines: list[str], said: list[str]) -> Block:
    code, skip, run = "\n".join(lines) + "\n", None, False
    for text in said:
        if match := SKIP.fullmatch(text):
            skip = match[1]
        elif text == "run":
            run = True
        elif match := WRITE.fullmatch(text):
            if match[1] not in code:
                raise ValueError(f"{page}:{line}: {match[1]!r} is not in the block")
            code = code.replace(match[1], match[2])
        else:
            raise ValueError(f"{page}:{line}: unknown directive {text!r}")
    return Block(page, line, language, code, skip, run)


def commands(code: str) -> list[list[str]]:
    """Return the commands of a shell block, as words; comments and redirections go."""
    found = []
    for line in code.replace("\\\n", " ").splitlines():
        lexer = shlex.shlex(line, posix=True, punctuation_chars="&|;<>")
        lexer.whitespace_split = True
        words: list[str] = []
        for word in [*lexer, ";"]:
            if word[0] in "&|;":
                if words:
                    found.append(words)
                words = []
            else:
                words.append(word)
    return [_without_redirection(words) for words in found]


def _without_redirection(words: list[str]) -> list[str]:
    end = next((i for i, w in enumerate(words) if w[0] in "<>"), len(words))
    return words[:end]


def prose(page: Path) -> str:
    """Return the page without its code blocks."""
    return re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)


def links(page: Path) -> list[str]:
    """Return what the page links to or shows, but for addresses on the web."""
    targets = LINK.findall(prose(page))
    return [t for t in targets if not re.match(r"(https?|mailto):", t)]


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as web sites for Markdown make them."""
    headings = re.findall(r"^#+ (.*)$", prose(page), flags=re.M)
    return {re.sub(r"[^\w\- ]", "", h.lower()).replace(" ", "-") for h in headings}
