"""Progress of a command: a live display in a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from rich.console import Console, ConsoleOptions, RenderableType
from rich.live import Live
from rich.segment import Segment
from rich.text import Text

from p2gs_jax.core.text import as_clock, printable

# Least time between two lines of progress outside a terminal, seconds.
EVERY_S = 5.0


class PlainConsole(Console):
    """A console of rich that prints markup and control characters without their effect."""

    def __init__(self, **options: Any):
        super().__init__(highlight=False, markup=False, emoji=False, **options)

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterator[Segment]:
        """Yield segments whose text is printable; styles are kept."""
        for segment in super().render(renderable, options):
            if segment.control:
                yield segment
            else:
                yield Segment(printable(segment.text), segment.style)


@dataclass(frozen=True)
class LogRecord:
    """A line of `log.jsonl` (docs/files.md has units), and the content of the live display."""

    step: int
    progress: float
    loss: float
    psnr: float
    gaussians: int
    shrink: int
    entries: int
    seconds: float
    step_seconds: float
    left_s: float | None
    terms: dict[str, float]
    steps: int | None = None  # of the whole run; None: unknown, under a time budget

    def summary(self) -> str:
        """Return the progress of the run as text."""
        of = "" if self.steps is None else f" of {self.steps}"
        left = "" if self.left_s is None else f", {as_clock(self.left_s)} left"
        scores = f"loss {self.loss:.4f}, training PSNR {self.psnr:.2f} dB"
        return f"step {self.step}{of}, {scores}{left}, {self.gaussians} Gaussians"


class Reporter:
    """Receives the progress and the messages of a command; this class ignores them."""

    def message(self, text: str) -> None:
        """Receive a sentence that the user must know."""

    def stage(self, name: str, done: int = 0, total: int = 0) -> None:
        """Begin or advance a stage."""

    def log(self, record: LogRecord) -> None:
        """Show the state of the optimisation."""


Silent = Reporter


class TerminalReporter(Reporter):
    """Prints messages as lines; progress is a live bar in a terminal, elsewhere a line every 5 s.

    It is a context manager.
    """

    def __init__(self, console: Console | None = None):
        self.console = console or PlainConsole(file=sys.stderr)
        self.live: Live | None = None
        self._printed_at = time.monotonic()

    def __enter__(self) -> TerminalReporter:
        if self.console.is_terminal:
            self.live = Live(console=self.console, refresh_per_second=8, transient=True)
            self.live.start()
        return self

    def __exit__(self, *exc) -> None:
        if self.live is not None:
            self.live.stop()

    def message(self, text: str) -> None:
        """Print a line that stays."""
        self.console.print(Text(text))

    def stage(self, name: str, done: int = 0, total: int = 0) -> None:
        """Show a stage and its progress."""
        text = f"{name} {done}/{total}" if total else f"{name} ..."
        self.show(Text(text), text)

    def show(self, display: RenderableType, line: str) -> None:
        """Show a display in a terminal; elsewhere print a line, at most every EVERY_S."""
        if self.live is not None:
            self.live.update(display)
        elif time.monotonic() - self._printed_at >= EVERY_S:
            self._printed_at = time.monotonic()
            self.console.print(Text(line), soft_wrap=True)

    def log(self, record: LogRecord) -> None:
        """Show the progress of the optimisation."""
        text = f"{record.progress:4.0%}  {record.summary()}"
        bar = f"{'█' * int(12 * record.progress):<12} {text}"
        self.show(Text(bar, no_wrap=True, overflow="ellipsis"), text.strip())
