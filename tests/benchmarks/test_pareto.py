"""The parts of pareto.py and views.py that take no hours: the front, means over sets, which photos are inputs."""

import json
from argparse import Namespace
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

import pareto
import views
from common.output import machine
from querysplat_cli.evaluation.axes import axes


def row(name: str, use: str, setting: str, seconds: float, grey: float) -> dict[str, Any]:
    working, full = {"black": 0, "grey": 0}, {"black": grey + 1, "grey": grey, "corrected": 0, "ssim": 0}
    costs = {"cpu_seconds": seconds, "seconds": 0, "gib": 0, "gaussians": 0}
    return {"set": name, "use": use, "quality": setting, "working": working, "full": full, **costs}


def test_the_front_holds_what_nothing_beats() -> None:
    assert pareto.frontier([(1, 20), (2, 19), (3, 25), (3, 24), (9, 25), (10, 26)]) == [0, 2, 5]
    assert pareto.frontier([]) == []


def test_means_are_over_sets_that_have_every_setting(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = [row("a", "tuned on", "default", 10, 20), row("b", "tuned on", "default", 30, 24)]
    rows += [row("a", "tuned on", "20 steps", 4, 18), row("c", "only reported", "default", 1, 1)]
    found = pareto.means(pareto.whole_sets(rows, "tuned on"))
    assert {name: (row[pareto.COST], row[pareto.SCORE]) for name, row in found.items()} == {
        "default": (10, 20),
        "20 steps": (4, 18),
    }
    assert list(pareto.means(pareto.whole_sets(rows, "only reported"))) == ["default"]
    assert pareto.best(found) == ["20 steps", "default"]
    pareto.summarise(rows)
    printed = capsys.readouterr().out
    assert "| **20 steps** | 0.00 | 0.00 | 19.00 | 18.00 |" in printed
    assert "tuned on, 1 sets" in printed  # the other one lacks a setting
    pareto.draw(rows, tmp_path / "front.svg")
    assert "feed-forward" not in (tmp_path / "front.svg").read_text()
    assert (tmp_path / "front.svg").stat().st_size > 5000


def test_settings_are_options_of_reconstruct() -> None:
    known = {f"--{name.replace('_', '-')}" for name in axes()} | {"--budget"}
    named = {option for options in pareto.SETTINGS.values() for option in options if option.startswith("--")}
    assert named <= known
    assert pareto.SETTINGS["default"] == ()


def test_small_photos_make_the_same_scene_with_larger_pictures() -> None:
    assert [pareto.same_scene("896 px", longer) for longer in (448, 449)] == ["default", None]
    assert [pareto.same_scene("1600 px", longer) for longer in (300, 897)] == ["default", None]
    assert pareto.same_scene("1600 px", 768) == "896 px"
    assert pareto.same_scene("224 px", 200) is None


@pytest.mark.parametrize("count", views.VIEWS)
def test_inputs_surround_the_held_out_photos(count: int) -> None:
    places = views.chosen(count, 50)
    assert len(places) == len(set(places)) == count
    assert not set(views.HELD) & set(places)
    assert places[0] >= 0
    assert places[-1] < 50
    if count > 1:
        assert places[0] < min(views.HELD)
        assert places[-1] > max(views.HELD)
        assert max(after - before for before, after in pairwise(places)) <= views.FARTHEST + 1


def test_rows_that_are_added_leave_the_others_their_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = row("fox", "tuned on", "default", 10, 20) | {"views": 2}
    monkeypatch.setattr(pareto, "row_of", lambda *given: row("fox", "tuned on", "20 steps", 4, 18))
    monkeypatch.setattr(views, "measure", lambda *given: {"views": 3, "error": "too few photos"})
    monkeypatch.setattr(
        views, "PHOTO_SETS", {"fox": Namespace(files=lambda data: 50 * [data / "fox" / "images" / "1"])}
    )
    found = tmp_path / "found.json"
    for program, chosen in ((pareto, ["--sets", "fox", "--settings", "20 steps"]), (views, ["--views", "3"])):
        found.write_text(json.dumps({"machine": "an old one", "rows": [before]}))
        for _ in range(2):
            monkeypatch.setattr("sys.argv", ["benchmark", str(tmp_path), *chosen, "--json", str(found)])
            program.main()
            machines = [each.get("machine") for each in json.loads(found.read_text())["rows"]]
            assert machines == ["an old one", machine()], program.__name__
