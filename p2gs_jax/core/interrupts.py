"""Signals that ask a program to end: it ends as after Ctrl-C, and first where it can be continued.

Only handlers of the system and of Python are replaced: what `nohup` or another program has set
stays. Outside the main thread Python delivers no signals, and nothing here does anything.
"""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Interrupted(KeyboardInterrupt):
    """A signal of this number asked the program to end."""

    def __init__(self, number: int):
        super().__init__(number)
        self.number = number


def name_of(number: int) -> str:
    """Return how a user knows a signal: "Ctrl-C", "SIGTERM"."""
    return "Ctrl-C" if number == signal.SIGINT else signal.Signals(number).name


def exit_code(error: KeyboardInterrupt) -> int:
    """Return the exit code by which shells and batch systems know the signal: 128 + its number."""
    return 128 + (error.number if isinstance(error, Interrupted) else int(signal.SIGINT))


def raised() -> contextlib.AbstractContextManager[None]:
    """Let signals that ask for the end raise `Interrupted` within a `with` block.

    Raises:
        Interrupted: such a signal came.
    """
    return _handled_by(_raise)


class Held:
    """Signals that wait until the program is where it can be continued.

    `arrived` is the number of the signal that waits, or None.
    """

    def __init__(self):
        self.arrived: int | None = None
        self._holding = False

    def begin(self) -> None:
        """Hold signals from here on; before, there is nothing to lose and they raise at once."""
        self._holding = True

    def deliver(self) -> None:
        """Raise what waits.

        Raises:
            Interrupted: a signal has arrived.
        """
        if self.arrived is not None:
            number, self.arrived = self.arrived, None
            raise Interrupted(number)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        # Who asks twice will not wait.
        if not self._holding or self.arrived is not None:
            raise Interrupted(number)
        self.arrived = number


@contextlib.contextmanager
def held() -> Iterator[Held]:
    """Hold signals that ask for the end within a `with` block; a second one raises at once.

    What still waits is raised at the end of the block.

    Raises:
        Interrupted: a signal was delivered.
    """
    waiting = Held()
    with _handled_by(waiting._handle):
        yield waiting
    waiting.deliver()


def _raise(number: int, frame: FrameType | None) -> None:
    raise Interrupted(number)


@contextlib.contextmanager
def _handled_by(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    before = {}
    if threading.current_thread() is threading.main_thread():
        ours = (signal.SIG_DFL, signal.default_int_handler, _raise)
        before = {n: signal.getsignal(n) for n in SIGNALS if signal.getsignal(n) in ours}
    for number in before:
        signal.signal(number, handler)
    try:
        yield
    finally:
        for number, former in before.items():
            signal.signal(number, former)
