"""Signals that end a program raise `Interrupted`, at once or when the program can continue."""

import gc
import importlib
import os
import signal
import sys
import threading
import time

import pytest

from p2gs_jax.core import interrupts

TERM, INT = signal.SIGTERM, signal.SIGINT


def send(number=TERM):
    os.kill(os.getpid(), number)


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_a_signal_raises_within_the_block_and_the_former_handler_is_back_after_it(name):
    number = getattr(signal, name)
    before = signal.getsignal(number)
    with pytest.raises(interrupts.Interrupted) as stop, interrupts.raised():
        send(number)
    assert isinstance(stop.value, KeyboardInterrupt)
    assert interrupts.exit_code(stop.value) == 128 + number
    assert signal.getsignal(number) == before


def test_ctrl_c_has_the_exit_code_of_shells():
    assert interrupts.exit_code(KeyboardInterrupt()) == 130
    assert interrupts.name_of(INT) == "Ctrl-C"
    assert interrupts.name_of(TERM) == "SIGTERM"


@pytest.mark.parametrize(
    ("begins", "sent", "delivered", "reached", "raised"),
    [
        (True, [TERM], True, 1, TERM),  # waits until it is delivered
        (True, [TERM], False, 2, TERM),  # raised at the end of the block
        (False, [TERM], False, 0, TERM),  # raises at once before `begin`
        (True, [TERM, INT], False, 1, INT),  # a second signal raises at once
    ],
)
def test_a_held_signal_waits_until_the_program_can_be_continued(
    begins, sent, delivered, reached, raised
):
    trace = []

    def work():
        with interrupts.held() as waiting:
            if begins:
                waiting.begin()
            for number in sent:
                send(number)
                trace.append(waiting.arrived)
            if delivered:
                waiting.deliver()
            trace.append("end of the block")

    with pytest.raises(interrupts.Interrupted) as stop:
        work()
    assert trace == [TERM, "end of the block"][:reached]
    assert stop.value.number == raised


def test_a_signal_that_garbage_collection_drops_is_sent_again():
    sent = []

    def callback(phase, info):
        if not sent:
            sent.append(phase)
            send()

    def work():
        gc.callbacks.append(callback)
        try:
            gc.collect()
            time.sleep(5)
        finally:
            gc.callbacks.remove(callback)

    with pytest.raises(interrupts.Interrupted), interrupts.raised():
        work()


def test_a_signal_waits_for_the_end_of_an_import(tmp_path, monkeypatch):
    code = "import os\ntry:\n    os.kill(os.getpid(), 15)\n"
    code += "except BaseException as error:\n    raise ImportError from error\ncomplete = True\n"
    (tmp_path / "signalled_module.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)

    def work():
        importlib.import_module("signalled_module")
        time.sleep(5)

    with pytest.raises(interrupts.Interrupted), interrupts.raised():
        work()
    assert sys.modules.pop("signalled_module").complete


def test_handlers_of_other_programs_stay():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup does
    try:
        with interrupts.raised(), interrupts.held() as waiting:
            waiting.begin()
            send(signal.SIGHUP)
            assert waiting.arrived is None
    finally:
        signal.signal(signal.SIGHUP, before)


CHILD = """
import os, signal, time
from p2gs_jax.core import interrupts
try:
    with interrupts.raised():
        import p2gs_jax.scene.sfm.map
        import p2gs_jax.export.folders
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(5)
except interrupts.Interrupted:
    print("raised")
"""


def test_the_handlers_stay_when_pycolmap_is_imported(python):
    done = python("-c", CHILD)
    assert (done.stdout, done.stderr) == ("raised\n", "")


def test_other_threads_set_no_handlers():
    found = []

    def work():
        with interrupts.raised(), interrupts.held() as waiting:
            found.append((waiting.arrived, signal.getsignal(TERM)))

    before = signal.getsignal(TERM)
    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert found == [(None, before)]
