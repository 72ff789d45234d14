"""Signals that end a program as Ctrl-C does, at a point from which it can continue.

Only default handlers and the handler of `raised` are replaced; those of `nohup` and others stay.
Outside the main thread Python delivers no signals, and these functions have no effect.
"""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Interrupted(KeyboardInterrupt):
    """The signal `number` asked the program to end."""

    def __init__(self, number: int):
        super().__init__(number)
        self.number = number


def name_of(number: int) -> str:
    """Return the common name of a signal: "Ctrl-C", "SIGTERM"."""
    return "Ctrl-C" if number == signal.SIGINT else signal.Signals(number).name


def exit_code(error: KeyboardInterrupt) -> int:
    """Return the exit code for shells and batch systems: 128 + the number of the signal."""
    return 128 + (error.number if isinstance(error, Interrupted) else int(signal.SIGINT))


def raised() -> contextlib.AbstractContextManager[None]:
    """Let signals that end a program raise `Interrupted` within a `with` block."""
    return _handled_by(_raise)


def install_again() -> None:
    """Install the handlers that Python knows again, after a library has replaced them unseen."""
    if threading.current_thread() is threading.main_thread():
        for number in SIGNALS:
            if (handler := signal.getsignal(number)) is not None:
                signal.signal(number, handler)


class Held:
    """Signals that wait until the program has reached a point from which it can continue.

    `arrived` is the number of the signal that waits, or None.
    """

    def __init__(self):
        self.arrived: int | None = None
        self._holding = False

    def begin(self) -> None:
        """Hold signals from now on; earlier ones raise at once, as there is no state to lose."""
        self._holding = True

    def deliver(self) -> None:
        """Raise the waiting signal as `Interrupted`, if there is one."""
        if self.arrived is not None:
            number, self.arrived = self.arrived, None
            raise Interrupted(number)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        # A second signal ends the program at once.
        if not self._holding or self.arrived is not None:
            raise Interrupted(number)
        self.arrived = number


@contextlib.contextmanager
def held() -> Iterator[Held]:
    """Hold the signals, after `Held.begin`, until the end of a `with` block.

    A second signal raises `Interrupted` at once. A signal that still waits raises it at the end of
    the block.
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
        replaced = (signal.SIG_DFL, signal.default_int_handler, _raise)
        before = {n: signal.getsignal(n) for n in SIGNALS if signal.getsignal(n) in replaced}
    for number in before:
        signal.signal(number, handler)
    try:
        yield
    finally:
        for number, former in before.items():
            signal.signal(number, former)
