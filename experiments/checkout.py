"""What is checked out, so that a figure can be measured again."""

from __future__ import annotations

import subprocess
from pathlib import Path

HERE = Path(__file__).parent


def commit() -> str:
    """Return the short commit of this checkout and whether files differ, figures aside."""
    kept = [f":(top,exclude)experiments/**.{suffix}" for suffix in ("json", "md")]
    changed = _git("status", "--porcelain", "-uno", "--", ":/", *kept)
    return (_git("rev-parse", "--short", "HEAD") or "unknown") + (" and changes" if changed else "")


def _git(*words: str) -> str:
    done = subprocess.run(
        ["git", "-C", str(HERE), *words], capture_output=True, text=True, check=False
    )
    return done.stdout.strip()
