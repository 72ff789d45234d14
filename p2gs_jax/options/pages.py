"""`report` and `compare`: pages about finished runs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True)
class Report:
    """Explain a run on one page: exposures, seams, held-out views, training, what to watch."""

    run: Annotated[Path, tyro.conf.Positional]
    """Run folder."""
    out: Path | None = None
    """The page (default: RUN/report.html)."""
    pdf: bool = False
    """Print the page as a PDF as well, beside it (needs a Chromium or Chrome)."""
    render: bool = True
    """Load the scene and render for the seams; without, only what the run folder holds."""


@dataclass(frozen=True)
class Compare:
    """Compare finished runs: one table, one page."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Run folders; the first is the one that others are held against."""
    out: Path = Path("compare.html")
    """The page; the table lies beside it as Markdown, under the same name with .md."""
