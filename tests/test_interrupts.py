"""Ctrl-C, SIGTERM and SIGHUP are delayed until the end of a block, and none is lost."""

import signal
from contextlib import ExitStack
from threading import Thread

import pytest

from flexneedle.interrupts import SIGNALS, delay_signals


@pytest.fixture(autouse=True)
def handlers():
    """All act as Ctrl-C, and do so afterwards."""
    with ExitStack() as stack:
        for number in SIGNALS:
            stack.callback(signal.signal, number, signal.signal(number, signal.default_int_handler))
        yield
        assert [signal.getsignal(number) for number in SIGNALS] == [signal.default_int_handler] * len(SIGNALS)


@pytest.mark.parametrize("number", SIGNALS)
def test_an_interrupt_is_raised_after_the_block(number):
    done = []

    def block():
        with delay_signals():
            signal.raise_signal(number)
            done.append("block")

    with pytest.raises(KeyboardInterrupt):
        block()
    assert done == ["block"]


def test_in_nested_blocks_it_is_raised_after_the_last():
    done = []

    def blocks():
        with delay_signals():
            with delay_signals():
                signal.raise_signal(signal.SIGINT)
                done.append("inner")
            done.append("outer")

    with pytest.raises(KeyboardInterrupt):
        blocks()
    assert done == ["inner", "outer"]


@pytest.mark.parametrize("raised", SIGNALS)
def test_after_an_interrupt_while_handlers_are_set_again_none_is_lost(monkeypatch, raised):
    original, calls = signal.signal, []

    def interrupted(number, handler):
        calls.append(number)
        found = original(number, handler)
        if len(calls) == len(SIGNALS) + 1:  # the first of those that are set again
            signal.raise_signal(raised)
        return found

    monkeypatch.setattr(signal, "signal", interrupted)
    with pytest.raises(KeyboardInterrupt), delay_signals():
        pass
    monkeypatch.undo()
    for each in SIGNALS:
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(each)
        signal.signal(each, signal.default_int_handler)


def test_a_signal_without_a_handler_keeps_its_action():
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    with delay_signals():
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    signal.signal(signal.SIGTERM, signal.default_int_handler)


def test_other_threads_are_not_interrupted_anyway():
    found = []

    def block():
        with delay_signals():
            found.append(signal.getsignal(signal.SIGINT))

    thread = Thread(target=block)
    thread.start()
    thread.join()
    assert found == [signal.default_int_handler]
