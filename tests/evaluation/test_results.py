"""Results on disk: their summary, their merging, and runs that are refused."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from made_results import result, split, start

from querysplat_cli.evaluation.keeping import Keeping
from querysplat_cli.evaluation.metrics import Meter
from querysplat_cli.evaluation.results import (
    RowFolder,
    open_row_folder,
    write_case,
    write_failure,
)
from querysplat_cli.evaluation.summary import summarise
from querysplat_cli.evaluation.sweep import Point, Spread, frontier, write_curves


def test_a_splits_figure_is_the_mean_over_views_and_the_average_that_over_splits(tmp_path: Path) -> None:
    """As in the release: a case with more scored views weighs more, a split with more cases does not."""
    small, large = split("small", "small"), split("large", "large", 1)
    kept = Keeping(rendered=True).writer({}, lambda frame: torch.zeros(3, 4, 4), Meter())
    row_folder = start(tmp_path, "free_tto=0", small)
    write_case(row_folder.case("s_000"), "s", result(10, 20, 30, seconds=1.0))
    write_case(row_folder.case("s_001"), "s", result(40, seconds=3.0), kept)
    row_folder = start(tmp_path, "free_tto=0", large)
    write_case(row_folder.case("s_000"), "s", result(11))
    write_failure(RowFolder(tmp_path, "free_tto=0", "large").case("s_001"), "s", "no overlap")
    summary = summarise(tmp_path)
    rows = {(row["split"], row["group"]): row for row in summary["rows"]}
    assert rows["small", "interp"]["psnr"] == 25
    assert rows["small", "interp"]["scored"] == 4
    assert rows["small", "extrap"]["psnr"] is None
    assert (rows["small", "extrap"]["scored"], rows["small", "extrap"]["asked"]) == (0, 2)
    assert rows["small", "interp"]["seconds_median"] == 3
    assert rows["small", "interp"]["peak_memory_gib"] == 0.75
    (average,) = [row for row in summary["averages"] if row["group"] == "interp"]
    assert average["psnr"] == pytest.approx((25 + 11) / 2)
    assert (average["splits"], average["failed"]) == (2, 1)
    assert [failure["error"] for failure in summary["failures"]] == ["no overlap"]
    assert (row_folder.out / "free_tto=0" / "small" / "s_001" / "rendered" / "interp" / "1.png").is_file()
    with (tmp_path / "summary.csv").open() as file:
        assert {row["psnr"] for row in csv.DictReader(file) if row["group"] == "interp"} == {"25.0", "11.0"}
    text = (tmp_path / "summary.md").read_text()
    assert "| free_tto=0 | 30.00 / 0.500 / – | 18.00 / 0.500 / – |" in text
    assert "No LPIPS" in text
    assert "no overlap" in text


def test_a_split_in_which_everything_failed_is_not_forgotten(tmp_path: Path) -> None:
    row_folder = start(tmp_path, "r", split("small", "small"))
    write_case(row_folder.case("s_000"), "s", result(20))
    row_folder = start(tmp_path, "r", split("large", "large"))
    for case in range(2):
        write_failure(row_folder.case(f"s_{case:03d}"), "s", "no overlap")
    (average,) = [row for row in summarise(tmp_path)["averages"] if row["group"] == "interp"]
    assert (average["psnr"], average["splits"], average["cases"], average["failed"]) == (20, 1, 1, 2)
    text = (tmp_path / "summary.md").read_text()
    assert "| 2 of 3 | 0 | 2 of 3 |" in text
    assert "| r | – / – / – | – / – / – | – / – / – | 0 of 0 | 0 | 2 of 2 |" in text


def test_views_of_failed_cases_are_asked_for_and_never_scored(tmp_path: Path) -> None:
    row_folder = start(tmp_path, "r", split("small", "small"))
    write_case(row_folder.case("s_000"), "s", result(20, 22))
    write_failure(row_folder.case("s_001"), "s", "its process ended", asked={"input": 1, "interp": 2, "extrap": 1})
    rows = {row["group"]: row for row in summarise(tmp_path)["rows"]}
    assert (rows["interp"]["psnr"], rows["interp"]["scored"], rows["interp"]["asked"]) == (21, 2, 4)
    assert (rows["extrap"]["scored"], rows["extrap"]["asked"]) == (0, 2)


def test_targets_that_share_nothing_are_counted_apart(tmp_path: Path) -> None:
    """The protocol's mean holds them; a second mean leaves them out."""
    row_folder = start(tmp_path, "r", split("small", "small", 1))
    apart = {"input": [], "interp": ["1.png"], "extrap": []}
    write_case(row_folder.case("s_000"), "s", replace(result(10, 20, 30), apart=apart))
    summary = summarise(tmp_path)
    (row,) = [row for row in summary["averages"] if row["group"] == "interp"]
    assert (row["psnr"], row["psnr_shared"], row["apart"]) == (20, 25, 1)
    metrics = json.loads((row_folder.case("s_000") / "metrics.json").read_text())
    assert metrics["apart"] == apart
    assert (
        "| r | 4 | interpolation | – / – / – | – / – / – | 25.00 / 0.500 / – |" in (tmp_path / "summary.md").read_text()
    )


def test_targets_without_a_score_are_counted_apart_as_well(tmp_path: Path) -> None:
    """One row scored the target, another has no picture of it, and a third failed."""
    on, apart = split("small", "small", 1), {"input": [], "interp": ["2.png"], "extrap": ["9.png"]}
    scored, missing = result(10, 20), result(10)
    missing.missing["interp"]["2.png"] = "it has no camera"
    write_case(start(tmp_path, "scored", on).case("s_000"), "s", replace(scored, apart=apart))
    write_case(start(tmp_path, "missing", on).case("s_000"), "s", replace(missing, apart=apart))
    asked = {"input": 1, "interp": 2, "extrap": 1}
    write_failure(start(tmp_path, "failed", on).case("s_000"), "s", "no overlap", asked=asked, apart=apart)
    counts = {(row["row"], row["group"]): (row["apart"], row["asked"]) for row in summarise(tmp_path)["rows"]}
    for row in ("scored", "missing", "failed"):
        assert [counts[row, group] for group in ("input", "interp", "extrap")] == [(0, 1), (1, 2), (1, 1)]


def test_quoted_rows_name_their_source(tmp_path: Path) -> None:
    row_folder = start(tmp_path, "free_tto=0", split("small", "small"))
    write_case(row_folder.case("s_000"), "s", result(20))
    summary = summarise(tmp_path)
    assert all(row["where"] and row["views"] == 4 for row in summary["quoted"]["rows"])
    assert summary["quoted"]["splits"]["small"] == summary["quoted"]["rows"]
    text = (tmp_path / "summary.md").read_text()
    quoted = text[text.index("Quoted from the paper") :]
    line = "| QuerySplat | free | 29.57 / 0.923 / 0.087 | 27.19 / 0.875 / 0.118 | 23.26 / 0.789 / 0.194 | Appendix A |"
    assert quoted.count(line) == 2  # beside the average of the one split, and beside the split
    assert not any("QuerySplat + TTO" in row["row"] for row in summary["rows"])


def test_the_average_of_all_scales_stands_beside_the_main_table(tmp_path: Path) -> None:
    for scale in ("small", "medium", "large"):
        row_folder = start(tmp_path, "free_tto=0", split(scale, scale, 1))
        write_case(row_folder.case("s_000"), "s", result(20))
    text = summarise(tmp_path) and (tmp_path / "summary.md").read_text()
    average = text[: text.index("## small")]
    assert "| QuerySplat | free | 27.90 / 0.884 / 0.124 | 24.58 / 0.800 / 0.184 |" in average
    assert (
        "| QuerySplat, official-8192 (SH degree 1) | free | – | 24.34 / – / – | – | README of the release |" in average
    )
    assert "| YoNoSplat | given |" in average
    assert "24.34" not in text[text.index("## small") :]


def test_timing_has_every_stage(tmp_path: Path) -> None:
    write_case(tmp_path / "c", "s", result(12, seconds=4.0))
    timing = json.loads((tmp_path / "c" / "timing.json").read_text())
    assert timing["seconds"] == {"cameras": 1.0, "tto": 4.0, "total": 5.0}
    assert (timing["peak_memory_gib"], timing["gaussians"]) == (0.75, 10)
    cameras = np.load(tmp_path / "c" / "cameras.npz")
    assert cameras["groups"].tolist() == ["input", "interp"]
    assert cameras["w2c"].shape == (2, 4, 4)


def point(row: str, psnr: float, seconds: float, views: int = 4) -> Point:
    none = Spread(None, None, None)
    figures = dict.fromkeys(("psnr", "ssim", "lpips", "seconds", "gaussians", "peak_memory_gib"), none)
    return Point(row, views, "interp", 1, figures | {"psnr": _at(psnr), "seconds": _at(seconds)})


def _at(value: float) -> Spread:
    return Spread(float(value), float(value), float(value))


def test_the_frontier_holds_what_nothing_beats() -> None:
    points = [point("fast", 20, 1), point("slow", 25, 9), point("beaten", 19, 2), point("tied", 20, 1)]
    points += [point("even", 25, 10), point("other", 10, 99, views=2)]
    best = {each.row for each in frontier(points) if "psnr for seconds" in each.best}
    assert best == {"fast", "tied", "slow", "other"}
    assert not any("lpips" in pair for each in frontier(points) for pair in each.best)
    fewer = replace(points[0], figures=points[0].figures | {"lpips": _at(0.4)})
    worse = replace(points[1], figures=points[1].figures | {"lpips": _at(0.2)})
    marked = frontier([fewer, worse])
    assert ["lpips for seconds" in each.best for each in marked] == [True, True]


def test_curves_are_written(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    for row, psnr, seconds in (("a", 10, 1.0), ("b", 20, 3.0)):
        row_folder = start(tmp_path, row, split("small", "small"))
        for case in range(2):
            write_case(row_folder.case(f"s_{case:03d}"), "s", result(psnr + case, seconds=seconds))
    points = write_curves(tmp_path)
    assert [(each.row, each.figures["psnr"].middle, each.figures["seconds"].middle) for each in points] == [
        ("a", 10.5, 2.0),
        ("b", 20.5, 4.0),
    ]
    assert "| **b** | 2 | 20.50 (20.25–20.75) |" in (tmp_path / "sweep.md").read_text()
    assert (tmp_path / "sweep.png").read_bytes()[:4] == b"\x89PNG"
    assert "<svg" in (tmp_path / "sweep.svg").read_text()
    assert len(json.loads((tmp_path / "sweep.json").read_text())) == 2
    assert (tmp_path / "sweep.csv").read_text().startswith("row,views,group,cases,psnr_median")


def test_force_begins_again_and_leaves_other_folders_alone(tmp_path: Path) -> None:
    row_folder, config = start(tmp_path, "free_tto=0", split("small", "small")), {"tto": 5}
    (row_folder.path / "case").mkdir()
    open_row_folder(row_folder, config, force=True)
    assert [path.name for path in row_folder.path.iterdir()] == ["run_config.json"]
    mine = RowFolder(tmp_path, "mine", "small")
    mine.path.mkdir(parents=True)
    (mine.path / "letter.txt").touch()
    open_row_folder(mine, config, force=True)
    assert (mine.path / "letter.txt").is_file()
