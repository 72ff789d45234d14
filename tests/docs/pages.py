"""Reading the documentation: its code blocks, the directives for their tests, and its links.

The language of a block decides its test. Directives are comments right above the block:

    <!-- test: skip (why) -->               it cannot run here
    <!-- test: write "300.0" as "2.0" -->   so that it ends soon; can be repeated
"""

import re
import shlex
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
OUTSIDE = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")]
PAGES = sorted([*OUTSIDE, *(ROOT / "docs").rglob("*.md")])
LANGUAGES = ("python", "sh", "toml", "json", "text", "")

DIRECTIVE = re.compile(r"<!-- test: (.*?) -->")
WRITE = re.compile(r'write "(.*)" as "(.*)"')
SKIP = re.compile(r"skip \((.+)\)")
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")


class Block(NamedTuple):
    """A code block after replacements, its first line, and the reason to skip it."""

    page: Path
    line: int
    language: str
    code: str
    skip: str | None

    @property
    def name(self) -> str:
        return f"{self.page.relative_to(ROOT)}:{self.line}"


def blocks(page: Path) -> list[Block]:
    """Return the code blocks of a page; a wrong directive raises a ValueError."""
    found, directives, inside = [], [], None
    for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), 1):
        if inside is not None:
            if line.strip() == "```":
                found.append(_block(page, *inside, directives))
                inside, directives = None, []
            else:
                inside[2].append(line)
        elif line.startswith("```"):
            inside = (number + 1, line[3:].strip(), [])
        elif here := DIRECTIVE.findall(line):
            directives += here
        elif line.strip() and directives:
            raise ValueError(f"{page}:{number}: a test directive must stand above a code block")
    if inside is not None:
        raise ValueError(f"{page}: the code block of line {inside[0]} stays open")
    return found


def _block(page: Path, line: int, language: str, lines: list[str], directives: list[str]) -> Block:
    code, skip = "\n".join(lines) + "\n", None
    for text in directives:
        if match := SKIP.fullmatch(text):
            skip = match[1]
        elif (match := WRITE.fullmatch(text)) and match[1] in code:
            code = code.replace(match[1], match[2])
        else:
            raise ValueError(f"{page}:{line}: {text!r} is not a directive, or is not in the block")
    return Block(page, line, language, code, skip)


def commands(code: str) -> list[list[str]]:
    """Return the commands of a shell block, as words, without comments and redirections."""
    found = []
    for line in code.replace("\\\n", " ").splitlines():
        lexer = shlex.shlex(line, posix=True, punctuation_chars="&|;<>")
        lexer.whitespace_split = True
        words: list[str] = []
        for word in [*lexer, ";"]:
            if word[0] not in "&|;":
                words.append(word)
                continue
            end = next((i for i, w in enumerate(words) if w[0] in "<>"), len(words))
            found += [words[:end]] if words else []
            words = []
    return found


def prose(page: Path) -> str:
    return re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)


def links(page: Path) -> list[str]:
    """Return the targets of links and images, except addresses on the web."""
    return [t for t in LINK.findall(prose(page)) if not re.match(r"(https?|mailto):", t)]


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings, made like GitHub's."""
    headings = re.findall(r"^#+ (.*)$", prose(page), flags=re.M)
    return {re.sub(r"[^\w\- ]", "", h.lower()).replace(" ", "-") for h in headings}
