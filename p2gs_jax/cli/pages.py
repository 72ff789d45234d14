"""`view`, `report` and `compare`: runs in the browser, on a page and in tables."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import tyro

from p2gs_jax.cli.shared import RunPath, SceneFolder, check, require_viewer


@dataclass(frozen=True)
class View:
    """Show a run in the browser, at any exposure, also while it is being fitted.

    p2gs-jax view runs/street
    """

    run: RunPath
    scene: SceneFolder = None
    port: int = 8080
    """Port to listen on; 0: any free port."""
    host: str = "127.0.0.1"
    """Address to listen on (plain HTTP); 0.0.0.0: all who have the printed address can connect."""
    max_width: int = 1920
    """Largest width of rendered pictures, pixels; wider windows enlarge them."""
    with_fit: bool = False
    """Stop the viewer when the fit that writes the run ends."""

    def execute(self) -> int:
        """Show the run in the browser until Ctrl-C."""
        from p2gs_jax.core.progress import PlainConsole

        require_viewer()
        import jax

        from p2gs_jax.viewer.follow import Follower
        from p2gs_jax.viewer.server import check_address, serve

        check(self.max_width >= 64, "--max-width must be at least 64")
        check_address(self.host, self.port)
        say = partial(PlainConsole().print, soft_wrap=True)
        follower = Follower(self.run, self.scene, with_fit=self.with_fit)
        if goes_on := follower.goes_on:
            jax.config.update("jax_platforms", "cpu")  # the fit uses the GPU's memory
        run = follower.first(say)
        place = {"host": self.host, "port": self.port, "max_width": self.max_width}
        serve(run, say=say, follower=follower if goes_on else None, **place)
        return 0


@dataclass(frozen=True)
class Report:
    """Explain a run on one page: exposures, seams, views, training.

    p2gs-jax report runs/street
    """

    run: RunPath
    out: Path | None = None
    """File of the page (default: RUN/report.html)."""
    scene: SceneFolder = None
    render: bool = True
    """Load the scene and render it to measure seams; otherwise use only the run folder."""

    def execute(self) -> int:
        """Write the page; return 1 if a file of the run is broken."""
        from p2gs_jax.core.progress import PlainConsole, TerminalReporter
        from p2gs_jax.report.report import write_report
        from p2gs_jax.report.run_files import read_run

        with TerminalReporter() as reporter:
            page = write_report(
                self.run, self.out, scene=self.scene, render=self.render, reporter=reporter
            )
            found = read_run(self.run, self.scene)
            for sentence in found.missing:
                reporter.message(sentence)
        PlainConsole().print(f"{page} ({page.stat().st_size / 2**20:.1f} MB)")
        return 1 if found.broken else 0


@dataclass(frozen=True)
class Compare:
    """Compare finished runs: scores, options that differ, exposures.

    p2gs-jax compare runs/robust runs/paper --out compare.md
    """

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN [RUN ...]")]
    """Run folders; the others are compared with the first."""
    out: Path | None = None
    """Markdown file for the tables (default: none)."""

    def execute(self) -> int:
        """Print the runs side by side, and write the file."""
        from p2gs_jax.cli.tables import make_table
        from p2gs_jax.core.atomic import write_text
        from p2gs_jax.core.progress import PlainConsole
        from p2gs_jax.report.compare import compare_runs, starred, to_markdown

        found, console = compare_runs(self.runs), PlainConsole()
        for remark in found.remarks:
            console.print(remark)
        for title, rows in found.tables.items():
            best = " (* best)" if any(row.best for row in rows) else ""
            cells = [(row.name, *starred(row)) for row in rows]
            console.print(make_table(("", *found.labels), cells, title + best))
        for sentence in found.sentences:
            console.print(sentence)
        if self.out is not None:
            write_text(self.out, to_markdown(found))
        return 0
