"""Results of several runs are merged, and damaged ones are refused."""

import json
import shutil
from pathlib import Path

import pytest
from made_results import result, split, start

from querysplat_cli.evaluation.results import row_folders, write_case, write_failure
from querysplat_cli.evaluation.shards import merge
from querysplat_cli.evaluation.summary import summarise
from querysplat_cli.runtime.errors import QuerySplatError


def test_shards_add_up(tmp_path: Path) -> None:
    whole, parts = split("small", "small", 4), [tmp_path / "1", tmp_path / "2"]
    for number in range(4):
        for out in (tmp_path / "all", parts[number % 2]):
            row_folder = start(out, "free_tto=0", whole)
            write_case(row_folder.case(f"s_{number:03d}"), "s", result(10.0 * number, 15))
    merge(parts, tmp_path / "merged")
    assert summarise(tmp_path / "merged")["rows"] == summarise(tmp_path / "all")["rows"]
    assert [(row_folder.row, row_folder.split) for row_folder in row_folders(tmp_path / "merged")] == [
        ("free_tto=0", "small")
    ]


def test_a_scored_case_wins_over_a_failed_one(tmp_path: Path) -> None:
    whole = split("small", "small", 1)
    write_failure(start(tmp_path / "1", "r", whole).case("s_000"), "s", "the machine was full")
    write_case(start(tmp_path / "2", "r", whole).case("s_000"), "s", result(12))
    merge([tmp_path / "1", tmp_path / "2"], tmp_path / "merged")
    summary = summarise(tmp_path / "merged")
    assert summary["failures"] == []
    assert summary["averages"][1]["psnr"] == 12


def test_different_runs_do_not_mix(tmp_path: Path) -> None:
    start(tmp_path / "1", "r", split("small", "small"))
    start(tmp_path / "1", "r", split("small", "small"))  # going on is allowed
    with pytest.raises(QuerySplatError, match=r"other settings \(settings\)"):
        start(tmp_path / "1", "r", split("small", "small"), tto=5)
    with pytest.raises(QuerySplatError, match=r"other settings \(split\)"):
        start(tmp_path / "1", "r", split("small", "small", 3))
    further = tmp_path / "1" / "r" / "small" / "run_config.json"
    further.write_text(json.dumps({**json.loads(further.read_text()), "metrics": ["flip"]}))
    with pytest.raises(QuerySplatError, match=r"other settings \(metrics\)"):
        start(tmp_path / "1", "r", split("small", "small"))
    start(tmp_path / "2", "r", split("small", "small"), tto=5)
    with pytest.raises(QuerySplatError, match="other settings"):
        merge([tmp_path / "1", tmp_path / "2"], tmp_path / "merged")
    with pytest.raises(QuerySplatError, match="no results"):
        merge([tmp_path], tmp_path / "other")


def test_nothing_of_damaged_or_other_results_is_merged(tmp_path: Path) -> None:
    """A damaged copy would stay in the way of the next merging."""
    whole, out = split("small", "small", 2), tmp_path / "merged"
    for number in range(2):
        write_case(start(tmp_path / str(number), "r", whole).case(f"s_{number:03d}"), "s", result(12))
    damaged = tmp_path / "1" / "r" / "small" / "s_001"
    (damaged / "metrics.json").write_text("{")
    with pytest.raises(QuerySplatError, match=str(damaged)):
        merge([tmp_path / "0", tmp_path / "1"], out)
    assert not out.exists()
    shutil.rmtree(damaged)
    start(tmp_path / "2", "r", whole, tto=5)
    with pytest.raises(QuerySplatError, match="other settings"):
        merge([tmp_path / "0", tmp_path / "1", tmp_path / "2"], out)
    assert not out.exists()
    merge([tmp_path / "0", tmp_path / "1"], out)
    with pytest.raises(QuerySplatError, match="other settings"):
        merge([tmp_path / "2"], out)


@pytest.mark.parametrize(
    ("file", "entry", "value"),
    [
        ("s_000/timing.json", "seconds", {"total": "/"}),
        ("s_000/metrics.json", "per_view", {"input": [{"psnr": []}]}),
        ("run_config.json", "machine", None),
        ("run_config.json", "protocol", 1e30),
        ("run_config.json", "lpips", 0),
    ],
)
def test_results_of_other_types_are_refused(file: str, entry: str, value: object, tmp_path: Path) -> None:
    row_folder = start(tmp_path, "r", split("small", "small"))
    write_case(row_folder.case("s_000"), "s", result(12))
    damaged = row_folder.path / file
    damaged.write_text(json.dumps({**json.loads(damaged.read_text()), entry: value}))
    with pytest.raises(QuerySplatError, match=f"{file} is damaged: {entry}"):
        summarise(tmp_path)


def test_damaged_results_are_named(tmp_path: Path) -> None:
    row_folder = start(tmp_path, "r", split("small", "small"))
    write_case(row_folder.case("s_000"), "s", result(12))
    (row_folder.case("s_000") / "metrics.json").write_text("{")
    with pytest.raises(QuerySplatError, match=r"s_000/metrics\.json: cannot be read as JSON"):
        summarise(tmp_path)
