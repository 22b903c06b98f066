"""The documented table agrees with the stored summary."""

import eval_table


def test_every_row_and_every_quote_has_a_line() -> None:
    common = {"views": 4, "scored": 3, "asked": 4, "cases": 1, "failed": 1, "seconds_median": 1.26}
    common |= {"gaussians_median": 12345.0, "peak_memory_gib": None}
    averages = [
        {**common, "row": "free_tto=0", "group": "input", "psnr": 20.126, "ssim": 0.5},
        {**common, "row": "free_tto=0", "group": "interp", "psnr": None, "ssim": None},
    ]
    own = {"views": 4, "method": "QuerySplat"}
    quoted = [{**own, "group": group, "psnr": psnr, "ssim": None} for group, psnr in (("interp", 24.58), ("input", 9))]
    quoted += [{"views": 4, "method": "Rival", "group": "input", "psnr": 1, "ssim": 1}, {"views": 12}]
    lines = eval_table.table({"averages": averages, "quoted": {"rows": quoted}}).splitlines()
    assert lines[2] == "| 4 | free_tto=0 | 20.13 / 0.500 |  |  | 6 of 8 | 1 of 2 | 1.3 | 12,345 |  |"
    assert lines[3].startswith("| 4 | *quoted: QuerySplat* | 9.00 | 24.58 |  |")
    assert len(lines) == 4
    assert {line.count("|") for line in lines} == {11}


def test_the_use_of_each_set_is_said() -> None:
    assert eval_table.uses(["fox", "elsewhere"]) == "Photo sets: fox (tuned on), elsewhere (only reported)."
