"""The commit of this checkout, with which a figure can be measured again."""

from __future__ import annotations

import subprocess
from pathlib import Path

HERE = Path(__file__).parent


def commit(root: Path = HERE) -> str:
    """Return the short commit of a checkout and whether files but JSON and Markdown differ."""
    kept = [f":(top,exclude)experiments/**.{suffix}" for suffix in ("json", "md")]
    changed = git(root, "status", "--porcelain", "-uno", "--", ":/", *kept)
    named = git(root, "rev-parse", "--short", "HEAD") or "unknown"
    return named + (" and changes" if changed else "")


def git(root: Path, *words: str) -> str:
    """Return what git prints in a checkout, or an empty text where it fails."""
    command = ["git", "-C", str(root), *words]
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()
