"""Signals that ask for the end raise, or wait where they are held."""

import os
import signal
import threading

import pytest

from p2gs_jax.core import interrupts


def send(number=signal.SIGTERM):
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


def test_python_s_own_ctrl_c_has_the_code_of_the_shell():
    assert interrupts.exit_code(KeyboardInterrupt()) == 130
    assert interrupts.name_of(signal.SIGINT) == "Ctrl-C"
    assert interrupts.name_of(signal.SIGTERM) == "SIGTERM"


def test_a_held_signal_waits_until_it_is_delivered():
    passed = []

    def work():
        with interrupts.held() as waiting:
            waiting.begin()
            send()
            passed.append(waiting.arrived)
            waiting.deliver()
            passed.append("never")

    with pytest.raises(interrupts.Interrupted) as stop:
        work()
    assert passed == [signal.SIGTERM]
    assert stop.value.number == signal.SIGTERM


def test_a_held_signal_that_nobody_asks_for_is_raised_at_the_end():
    passed = []

    def work():
        with interrupts.held() as waiting:
            waiting.begin()
            send()
            passed.append("to the end")

    with pytest.raises(interrupts.Interrupted):
        work()
    assert passed


def test_before_there_is_something_to_lose_and_at_the_second_time_nothing_waits():
    def work(*numbers, begun):
        with interrupts.held() as waiting:
            if begun:
                waiting.begin()
            for number in numbers:
                send(number)
            pytest.fail("it waited")

    with pytest.raises(interrupts.Interrupted):
        work(signal.SIGTERM, begun=False)
    with pytest.raises(interrupts.Interrupted) as stop:
        work(signal.SIGTERM, signal.SIGINT, begun=True)
    assert stop.value.number == signal.SIGINT


def test_handlers_of_others_stay():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup does
    try:
        with interrupts.raised(), interrupts.held() as waiting:
            waiting.begin()
            send(signal.SIGHUP)
            assert waiting.arrived is None
    finally:
        signal.signal(signal.SIGHUP, before)


def test_other_threads_set_no_handlers():
    found = []

    def work():
        with interrupts.raised(), interrupts.held() as waiting:
            found.append((waiting.arrived, signal.getsignal(signal.SIGTERM)))

    before = signal.getsignal(signal.SIGTERM)
    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert found == [(None, before)]
