"""What `benchmarks/abuse.py` counts as a fault."""

import sys
from dataclasses import replace
from pathlib import Path

import pytest

from hostile import attempt as runs
from hostile.attempt import Outcome, attempt
from hostile.case import REFUSED, Case, one_file
from hostile.damage import drawn_json, drawn_ply
from hostile.killing import Length, attempt_kill
from hostile.whole import half_written

REFUSAL = Case("x", "a missing file", one_file("mine.txt", b"1"), ("info", "none.ply"), REFUSED)


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first command loads libraries."""
    monkeypatch.setattr(runs, "SLOW", 1e9)


def test_a_refusal_of_one_line_is_clean(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with capfd.disabled():
        outcome = attempt(REFUSAL, tmp_path)
    assert (outcome.code, outcome.faults, outcome.written) == (2, [], [])
    assert outcome.message.startswith("error: none.ply")
    assert not any(tmp_path.iterdir())


def test_a_wrong_code_is_a_fault(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with capfd.disabled():
        outcome = attempt(replace(REFUSAL, codes=frozenset({0})), tmp_path)
    assert outcome.faults == ["wrong code 2"]


@pytest.mark.parametrize(
    ("program", "fault"),
    [
        ("import sys; print(1 / 0)", "traceback"),
        ("open('mine.txt', 'w').write('2'); exit(2)", "touched"),
        ("open('new.txt', 'w').write('2')", "touched"),
        ("open('../new.txt', 'w').write('2')", "written outside"),
        ("import tempfile; tempfile.mkdtemp()", "temporary files"),
        ("exit(2)", "no message of one line"),
    ],
)
def test_faults_of_a_process(program: str, fault: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runs, "PROGRAM", (sys.executable, "-c", program))
    found = attempt(replace(REFUSAL, codes=frozenset({0, 1, 2}), kind="process"), tmp_path).faults
    assert any(each.startswith(fault) for each in found)


@pytest.mark.parametrize(
    ("name", "content"), [("s.ply", b"ply\n"), ("a.json", b"{"), ("a.html", b"<html>"), ("a.png", b"\x89PNG")]
)
def test_half_written_files_are_faults(name: str, content: bytes, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content)
    assert len(half_written(tmp_path)) == 1


WAITING = """
import os, signal, time
began = time.process_time()
signal.signal(signal.SIGTERM, lambda *_: os._exit(143))
while time.process_time() < began + 0.4: pass
signal.signal(signal.SIGTERM, signal.SIG_IGN)
while time.process_time() < began + 1.6: pass
"""
"""Python itself may take half a second to start where other work runs beside."""
HEEDLESS = "import os, signal, time\nsignal.signal(15, lambda *_: None)\nwhile time.process_time() < 3: pass"


def killed(program: str, length: float, folder: Path, monkeypatch: pytest.MonkeyPatch) -> Outcome:
    """The outcome of a SIGTERM at nearly the end of a program that is thought to take so many CPU seconds."""
    monkeypatch.setattr(runs, "PROGRAM", (sys.executable, "-c", program))
    place = {"signal": 15, "share": 0.99, "situation": "a", "server": False, "group": False}
    case = Case("kills", "a: SIGTERM", one_file("mine.txt", b"1"), (), frozenset({0, 143}), kind="kill", place=place)
    return attempt_kill(case, folder, {"a": Length(0.0, length)} if length else {})


def test_a_kill_is_drawn_earlier_until_it_reaches_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = killed(WAITING, 2.0, tmp_path, monkeypatch)
    assert (found.reached, found.code, found.faults) == (True, 143, [])
    assert len(found.instants) > 1
    assert found.instants == sorted(found.instants, reverse=True)


def test_the_length_of_a_command_is_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = killed(WAITING, 0.0, tmp_path, monkeypatch)
    assert found.reached
    assert found.instants[0] < 1.0


def test_a_command_that_goes_on_after_a_signal_is_a_fault(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = killed(HEEDLESS, 1.0, tmp_path, monkeypatch)
    assert not found.reached
    assert [fault[:8] for fault in found.faults] == ["went on "]


def test_hypothesis_draws_the_same_each_time() -> None:
    assert list(drawn_json(b'{"frames": [{"w": 1}]}', 5)) == list(drawn_json(b'{"frames": [{"w": 1}]}', 5))
    assert list(drawn_ply(5)) == list(drawn_ply(5))
