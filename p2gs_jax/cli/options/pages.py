"""`report` and `compare`: pages about finished runs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from p2gs_jax.cli.options.scene import SceneFolder


@dataclass(frozen=True)
class Report:
    """Explain a run on one page: exposures, seams, views, training.

    p2gs-jax report runs/street
    p2gs-jax report runs/street --pdf --out street.html
    """

    run: Annotated[Path, tyro.conf.Positional]
    """Run folder."""
    out: Path | None = None
    """The page (default: RUN/report.html)."""
    pdf: bool = False
    """Print the page as a PDF as well, beside it (needs a Chromium or Chrome)."""
    scene: SceneFolder = None
    """Where the run's scene lies now, if it is not where it was."""
    render: bool = True
    """Load the scene and render for the seams; without, only what the run folder holds."""


@dataclass(frozen=True)
class Compare:
    """Compare finished runs: one table, one page.

    p2gs-jax compare runs/robust runs/paper --out compare.html
    """

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN [RUN ...]")]
    """Run folders; the first is the one that others are held against."""
    out: Path = Path("compare.html")
    """The page; the table lies beside it as Markdown, under the same name with .md."""
