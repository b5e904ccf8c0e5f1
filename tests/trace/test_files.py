"""Ctrl-C is delayed until a record is complete."""

import signal

import pytest

from flexneedle.trace.files import uninterrupted


def test_an_interrupt_is_raised_after_the_block():
    done = []

    def interrupted_block():
        with uninterrupted():
            signal.raise_signal(signal.SIGINT)
            done.append("block")

    with pytest.raises(KeyboardInterrupt):
        interrupted_block()
    assert done == ["block"]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_without_an_interrupt_nothing_happens():
    with uninterrupted():
        pass
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
