"""Signals that end a program as Ctrl-C does, at a point from which it can continue.

Only default handlers and the handler of `raised` are replaced; those of `nohup` and others stay.
Outside the main thread Python delivers no signals, and these functions have no effect.
"""

from __future__ import annotations

import _thread
import contextlib
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
AGAIN_S = 0.1  # seconds until a signal that could not end the program is sent again


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
    """Let signals that end a program raise `Interrupted` within a `with` block.

    An import is completed first.
    """
    return _handled_by(_raise)


@contextlib.contextmanager
def kept() -> Iterator[None]:
    """Install Python's handlers again after a `with` block in which a library replaces them.

    Signals to this thread wait until then.
    """
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        yield
    finally:
        for number in SIGNALS:
            handler = signal.getsignal(number)
            if threading.current_thread() is threading.main_thread() and handler is not None:
                signal.signal(number, handler)
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


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
        if not self._holding:
            _raise(number, frame)
        elif self.arrived is not None:
            raise Interrupted(number)  # a second signal ends the program at once
        else:
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
    # Libraries turn an exception during their import into another one, or drop it.
    while frame is not None:
        if frame.f_code.co_filename == "<frozen importlib._bootstrap>":
            return _send_later(number)
        frame = frame.f_back
    raise Interrupted(number)


def _send_later(number: int) -> None:
    def send() -> None:
        time.sleep(AGAIN_S)
        signal.pthread_kill(threading.main_thread().ident or 0, number)

    # A handler may interrupt the start of a `threading.Thread`, and must not wait for its lock.
    _thread.start_new_thread(send, ())


@contextlib.contextmanager
def _handled_by(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    before, report = {}, sys.unraisablehook

    def dropped(unraisable: Any) -> None:
        # Python drops exceptions in callbacks of garbage collection; JAX has one.
        if isinstance(unraisable.exc_value, Interrupted):
            _send_later(unraisable.exc_value.number)
        else:
            report(unraisable)

    if threading.current_thread() is threading.main_thread():
        replaced = (signal.SIG_DFL, signal.default_int_handler, _raise)
        before = {n: signal.getsignal(n) for n in SIGNALS if signal.getsignal(n) in replaced}
        sys.unraisablehook = dropped
    for number in before:
        signal.signal(number, handler)
    try:
        yield
    finally:
        for number, former in before.items():
            signal.signal(number, former)
        if sys.unraisablehook is dropped:
            sys.unraisablehook = report
