"""How parts of `benchmarks/abuse.py` are joined, and what its page says of kills."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import pytest

from hostile.attempt import Outcome
from hostile.report import kill_table, page, table
from hostile.results import Made, Results, read, write


@pytest.fixture(autouse=True)
def second_commit(monkeypatch: pytest.MonkeyPatch) -> None:
    """What runs now runs at commit 2; the tests may run outside a repository."""
    monkeypatch.setattr("hostile.results.made_now", lambda: Made("2", "2026-11-24", "a machine"))


def outcome(family: str, what: str, code: int = 0, instants: tuple[float, ...] = ()) -> Outcome:
    return Outcome(family, what, code, 1.0, "", [], [], bool(code), list(instants))


def written(path: Path, commit: str, *found: Outcome) -> Path:
    made = {each.family: Made(commit, "2026-11-23", "a machine") for each in found}
    write(path, Results({(each.family, each.what): each for each in found}, made))
    return path


def test_a_family_takes_the_place_of_that_of_another_commit(tmp_path: Path) -> None:
    old = written(tmp_path / "a.json", "1", outcome("PLY", "a"), outcome("kills", "a"), outcome("kills", "b"))
    new = written(tmp_path / "b.json", "2", outcome("kills", "c"))
    found = read([old, new, tmp_path / "none.json"])
    assert list(found.outcomes) == [("PLY", "a"), ("kills", "c")]
    assert (found.made["PLY"].commit, found.made["kills"].commit) == ("1", "2")


def test_halves_of_a_family_are_joined_and_later_ones_win(tmp_path: Path) -> None:
    first = written(tmp_path / "a.json", "1", outcome("kills", "a"), outcome("kills", "b"))
    second = written(tmp_path / "b.json", "1", outcome("kills", "b", 130), outcome("kills", "c"))
    assert [each.code for each in read([first, second]).every] == [0, 130, 0]
    third = written(tmp_path / "c.json", "1, 2", outcome("kills", "d"))
    found = read([third, first])
    assert len(found.every) == 3
    assert found.made["kills"].commit == "1, 2"


def test_what_goes_on_at_another_commit_names_both(tmp_path: Path) -> None:
    results = read([written(tmp_path / "a.json", "1", outcome("kills", "a"))])
    results.add([outcome("kills", "b"), outcome("kills", "c")])
    assert results.made["kills"].commit == "1, 2"


def test_what_was_not_clean_and_ran_again_is_counted(tmp_path: Path) -> None:
    faulty = replace(outcome("kills", "a"), faults=["traceback"])
    results = read([written(tmp_path / "a.json", "1", faulty, outcome("kills", "b"))])
    results.add([outcome("kills", "a"), outcome("kills", "c")])
    assert results.made["kills"].again == 1
    write(tmp_path / "b.json", results)
    assert read([tmp_path / "b.json"]).made["kills"].again == 1


def test_fields_of_kills_are_left_out_elsewhere(tmp_path: Path) -> None:
    path = written(tmp_path / "a.json", "1", outcome("PLY", "a"), outcome("kills", "b", 130, (2.0, 1.0)))
    plain, kill = json.loads(path.read_text())["outcomes"]
    assert "instants" not in plain
    assert kill == asdict(read([path]).outcomes["kills", "b"])


def test_kills_that_reached_a_command_are_counted_by_command() -> None:
    kills = [
        outcome("kills", "doctor: SIGINT at 90.0%", 130, (2.0, 1.0)),
        outcome("kills", "doctor: SIGKILL at 10.0%", -9, (0.5,)),
        outcome("kills", "info: SIGTERM at 99.0%", 0, (2.0, 1.0, 0.5)),
    ]
    rows = kill_table(kills).splitlines()[2:]
    assert rows[0] == "| `doctor` | 2 | 1, 0, 0, 1 | 0.5 to 1.0 |"
    assert rows[1] == "| `info` | 1 | 0 each | – |"
    made = {"kills": Made("abc", "2026-11-23", "a machine")}
    shown = page(Results({("kills", each.what): each for each in kills}, made), "make", "What is clean.")
    shown = " ".join(shown.split())
    assert "2 of 3 kills ended a command that was running" in shown
    assert "at commit abc, on a machine, other work beside, on 2026-11-23" in shown
    assert "an earlier instant was drawn: 3 times" in shown


def test_families_stand_with_what_a_reader_asks_for_and_name_a_commit_of_their_own() -> None:
    found = {(family, "a"): outcome(family, "a", 2) for family in ("GPS", "PLY", "new", "films")}
    made = {family: Made("1", "2026-11-23", "a machine") for family in ("GPS", "PLY", "new")}
    rows = table(Results(found, {**made, "films": Made("2", "2026-11-24", "a machine")})).splitlines()[2:]
    assert [row.split(" | ")[0].strip("| *") for row in rows] == [
        "Gaussians in files", "PLY", "Photos", "films", "GPS", "Others", "new", "all",
    ]  # fmt: skip
    assert [row.rsplit(" | ", 1)[1].strip(" |") for row in rows if "films" in row or "GPS" in row] == [
        "2, 2026-11-24",
        "",
    ]
