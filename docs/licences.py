"""Writes licences.md: what the package stands on, and under which licences.

python docs/licences.py

From pyproject.toml and the metadata of what is installed. `BUNDLED` is by hand: the metadata of a
wheel says nothing of libraries that are built into it.
"""

from __future__ import annotations

import re
import tomllib
from importlib import metadata
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGE = Path(__file__).with_name("licences.md")
# Extras that a user installs; the others are for work on the program itself.
EXTRAS = ("viewer", "spz", "usd", "drives", "heic", "raw", "lpips", "dask", "slurm", "cuda")
# What wheels carry beside their own code, where it asks for more than to be named.
BUNDLED = {
    "av": "FFmpeg with x264 and x265: GPL-2.0-or-later",
    "opencv-contrib-python-headless": "FFmpeg: LGPL-2.1-or-later",
    "pillow-heif": "libheif and libde265: LGPL-3.0-or-later; x265: GPL-2.0-or-later",
    "rawpy": "LibRaw: LGPL-2.1 or CDDL-1.0",
    "jax[cuda12]": "NVIDIA's libraries: proprietary, may be redistributed",
}
HEAD = """\
# Licences

This page lists the dependencies of the package and their licences. The program itself is under
[Apache-2.0](../LICENSE) and is distributed without its dependencies: pip installs them, each under
its licence. Whoever distributes both together, for example as a container image, must comply with
all of these, and those marked **GPL** then apply to the whole. `python docs/licences.py` generates
the page from the installed packages, and a test checks that it is current.

| package | needed by | licence | what its wheel carries |
|---|---|---|---|
"""
TAIL = """
## Parts under the GPL

{parts}

This project neither copies nor changes them, and none of its files is under the GPL.

The tests compare PLY files with plyfile (GPL-3.0-or-later), which comes with the extra `test`; the
program neither imports nor requires it.
"""
WHY = {
    "av": "is under BSD-3-Clause, and its wheels contain x264 and x265. It reads and writes videos",
    "pillow-heif": "is under BSD-3-Clause, and its wheels contain x265. It reads HEIC photographs",
}


def main() -> None:
    """Write the page."""
    PAGE.write_text(page(), encoding="utf-8")


def declared() -> dict[str, str]:
    """Return the requirements of the package, and what needs each."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    found = {_name(said): "everything" for said in project["dependencies"]}
    for extra in EXTRAS:
        for said in project["optional-dependencies"][extra]:
            found.setdefault(_name(said), f"extra `{extra}`")
    return found


def licence_of(name: str) -> str | None:
    """Return a licence as the installed metadata says, or None where it is not installed."""
    try:
        said = metadata.metadata(name.partition("[")[0])
    except metadata.PackageNotFoundError:
        return None
    for expression in said.get_all("License-Expression", []):
        return expression
    classified = [
        c.rsplit(" :: ", 1)[1] for c in said.get_all("Classifier", []) if c.startswith("License ::")
    ]
    short = " ".join(said.get_all("License", [])).strip()
    if classified and (not short or len(short) > 40 or "\n" in short):
        return ", ".join(classified)
    return short if short and len(short) <= 40 else "see its files"


def is_gpl(text: str) -> bool:
    """Return whether a licence is the GPL, not the LGPL."""
    return bool(re.search(r"(?<!L)GPL|(?<!Lesser )General Public License", text))


def rows() -> dict[str, tuple[str, str, str]]:
    """Return by package what needs it, its licence, and what its wheel carries."""
    before = _written()
    found = {}
    for name, needed in sorted(declared().items()):
        licence = licence_of(name) or before.get(name, ("", "not installed here", ""))[1]
        found[name] = (needed, licence, BUNDLED.get(name, ""))
    return found


def page() -> str:
    """Return the page as Markdown."""
    lines = []
    for name, (needed, licence, carried) in rows().items():
        mark = " **GPL**" if is_gpl(licence) or is_gpl(carried) else ""
        lines.append(f"| {name} | {needed} | {licence}{mark} | {carried} |")
    parts = "\n".join(f"- **{name}** {why}." for name, why in WHY.items())
    return HEAD + "\n".join(lines) + "\n" + TAIL.format(parts=parts)


def _written() -> dict[str, tuple[str, str, str]]:
    """Return the rows of the page as it is, for what is not installed here."""
    found = {}
    for line in PAGE.read_text(encoding="utf-8").splitlines() if PAGE.exists() else ():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if line.startswith("| ") and len(cells) == 4:
            found[cells[0]] = (cells[1], cells[2].removesuffix(" **GPL**"), cells[3])
    return found


def _name(requirement: str) -> str:
    """Return a requirement without its versions, lower case."""
    found = re.match(r"[\w.-]+(\[[\w,-]+\])?", requirement)
    assert found is not None
    return found.group().lower()


if __name__ == "__main__":
    main()
