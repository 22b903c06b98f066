"""Signals that end a command are interruptions; they wait while two steps belong together."""

import os
import signal

import pytest

from querysplat_cli.runtime import signals


@pytest.fixture(autouse=True)
def handlers() -> object:
    before = {number: signal.getsignal(number) for number in signals.ENDING}
    signals.catch()
    yield
    for number, handler in before.items():
        signal.signal(number, handler)
    signals._State.received = None


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_each_raises_and_decides_the_exit_code(number: int, code: int) -> None:
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(number)
    assert signals.exit_code() == code


def test_without_a_signal_the_code_is_that_of_ctrl_c() -> None:
    assert signals.exit_code() == 130


def test_what_is_ignored_stays_ignored() -> None:
    """`nohup` starts a command with SIGHUP ignored."""
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    signals.catch()
    signal.raise_signal(signal.SIGHUP)
    assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN


def test_a_signal_waits_until_both_steps_are_done() -> None:
    steps = []

    def belong_together() -> None:
        with signals.held():
            steps.append(1)
            os.kill(os.getpid(), signal.SIGTERM)
            with signals.held():
                steps.append(2)
            steps.append(3)

    with pytest.raises(KeyboardInterrupt):
        belong_together()
    assert steps == [1, 2, 3]
    with signals.held():  # nothing waits any more
        pass
