"""`p2gs-jax report`."""

from __future__ import annotations

from rich.text import Text

from p2gs_jax.cli.commands.console import stdout
from p2gs_jax.cli.options.pages import Report
from p2gs_jax.core.progress import TerminalReporter
from p2gs_jax.report.page import find_browser, print_pdf
from p2gs_jax.report.report import write_report
from p2gs_jax.report.run_files import read_run


def run(options: Report) -> int:
    """Write the page of a run, and print it where that is asked for; 1 where a file is broken."""
    # Before anything is rendered: there may be no browser.
    browser = find_browser() if options.pdf else None
    with TerminalReporter() as reporter:
        page = write_report(
            options.run,
            options.out,
            scene=options.scene,
            render=options.render,
            reporter=reporter,
        )
        paths = [page]
        found = read_run(options.run, options.scene)
        for sentence in found.missing:
            reporter.message(sentence)
        if browser is not None:
            reporter.stage("Printing")
            paths.append(print_pdf(page, page.with_suffix(".pdf"), browser))
    for path in paths:
        stdout().print(Text(f"{path} ({path.stat().st_size / 2**20:.1f} MB)"))
    return 1 if found.broken else 0
