"""What `benchmarks/abuse.py` counts as a fault."""

import sys
from dataclasses import replace
from pathlib import Path

import pytest

from hostile import attempt as runs
from hostile.attempt import attempt
from hostile.case import REFUSED, Case, one_file
from hostile.damage import drawn_json, drawn_ply

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
    assert len(runs._half_written(tmp_path)) == 1


def test_hypothesis_draws_the_same_each_time() -> None:
    assert list(drawn_json(b'{"frames": [{"w": 1}]}', 5)) == list(drawn_json(b'{"frames": [{"w": 1}]}', 5))
    assert list(drawn_ply(5)) == list(drawn_ply(5))
