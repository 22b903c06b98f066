"""The documented tables, set by set, of a folder of results."""

import json
from pathlib import Path

import eval_table

COMMON = {"views": 4, "scored": 3, "apart": 0, "asked": 4, "cases": 1, "failed": 1, "gaussians_median": 12345.0}
COMMON |= {"peak_memory_gib": None}


def test_every_row_has_a_line() -> None:
    averages = [
        {**COMMON, "row": "free_tto=0", "group": "input", "psnr": 20.126, "ssim": 0.5},
        {**COMMON, "row": "free_tto=0", "group": "interp", "psnr": None, "ssim": None, "apart": 2},
        {**COMMON, "row": "free_tto=0", "group": "extrap", "psnr": 9.0, "ssim": None, "apart": 1, "asked": 5},
        {**COMMON, "row": "free_depth", "group": "input", "psnr": 1.0, "ssim": 0.1},
    ]
    lines = eval_table.table(averages, ["tto=0"]).splitlines()
    assert lines[2:] == ["| 4 | free_tto=0 | 20.13 / 0.500 |  | 9.00 | 9 of 13 | 3 of 9 | 1 of 2 | 12,345 |  |"]
    assert len(eval_table.table(averages).splitlines()) == 4
    assert {line.count("|") for line in lines} == {11}


def test_only_the_papers_own_method_is_quoted() -> None:
    rows = [{"views": 4, "method": "QuerySplat", "group": group, "psnr": 24.58, "ssim": None} for group in ("interp",)]
    rows.append({"views": 4, "method": "Rival", "group": "input", "psnr": 1, "ssim": 1})
    assert eval_table.quoted(rows).splitlines()[2:] == ["| 4 | QuerySplat |  | 24.58 |  |"]


def test_each_set_has_its_own_figures(tmp_path: Path) -> None:
    folder = tmp_path / "free_depth" / "2views_small"
    split = {"num_input_views": 2, "scale": "small"}
    config = {"split": split, "protocol": "release", "lpips": {"missing": "vgg"}, "machine": "here"}
    folder.mkdir(parents=True)
    (folder / "run_config.json").write_text(json.dumps(config))
    for case, psnr in (("fox_000", 20.0), ("fox_001", 22.0), ("two_words_002", 30.0)):
        (folder / case).mkdir()
        view = {"psnr": psnr, "ssim": 0.5}
        groups = {"per_view": {"input": [view]}, "mean": {"input": view}}
        metrics = {**groups, "missing": {}, "frames": {"input": [{"name": "a.png"}]}}
        (folder / case / "metrics.json").write_text(json.dumps(metrics))
        timing = {"seconds": {"total": 1.0}, "gaussians": 5, "peak_memory_gib": 1.0}
        (folder / case / "timing.json").write_text(json.dumps(timing))
    assert eval_table.sets_of(tmp_path) == ["fox", "two_words"]
    for name, psnr in (("fox", 21.0), ("two_words", 30.0)):
        summary = eval_table.summary_of(tmp_path, name, tmp_path / "tables")
        assert [cell["psnr"] for cell in summary["averages"] if cell["group"] == "input"] == [psnr]
        assert (tmp_path / "tables" / f"eval_{name}.csv").is_file()
