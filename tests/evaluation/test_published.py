"""The paper's figures in the package, against the paper's source where it is at hand, and against each other."""

import json
import re
from typing import Any

import pytest

import paper_tables
from common.locations import BESIDE
from paper_tables import FILE, RELEASE, read_tables, report
from querysplat_cli.evaluation import published

TEX = BESIDE / "spec" / "paper-tables.tex"
SYSTEMS = {"DepthSplat", "TokenGS", "YoNoSplat", "AnySplat", "NoPoSplat", "SPFSplat", "SplatWeaver", "QuerySplat"}


@pytest.fixture(scope="module")
def tex() -> str:
    if not TEX.is_file():
        pytest.skip(f"no {TEX}")
    return TEX.read_text()


def numbers(row: dict[str, Any]) -> list[float]:
    names = ("psnr", "ssim", "lpips", *(name for name in row if name.endswith(("seconds", "gib"))))
    return [row[name] for name in names if name in row]


def test_every_number_of_the_source_is_there_in_its_order(tex: str) -> None:
    """The digits are picked out of the source by themselves, not by the program that wrote the file."""
    bodies = re.findall(r"\\midrule(.*?)\\bottomrule", tex, re.DOTALL)
    measured = [table for table in published.tables() if table["label"] != "release-readme"]
    assert len(bodies) == len(measured) == 14
    for body, table in zip(bodies, measured, strict=True):
        printed = [float(digits) for digits in re.findall(r"(?<![\w.-])\d+\.\d{3,4}(?!\d)", body)]
        assert printed == [number for row in table["rows"] for number in numbers(row)], table["label"]
        assert len(printed) > 5


def test_the_program_reads_the_source_as_the_file_has_it(tex: str) -> None:
    assert [*read_tables(tex), RELEASE] == json.loads(FILE.read_text())["tables"] == published.tables()


def test_captions_name_what_the_rows_hold() -> None:
    seen = set()
    for table in published.tables():
        found = re.search(r"(\d+)-view.* (large|medium|small) split", table["caption"])
        if table["section"] == "Appendix A":
            assert found
            rows = {(row["views"], row["scale"]) for row in table["rows"]}
            assert rows == {(int(found[1]), found[2])}
            seen |= rows
            assert {row["group"] for row in table["rows"]} == {"input", "interp", "extrap"}
    assert len(seen) == 9


def test_every_system_has_its_rows() -> None:
    main = published.rows(views=2)
    assert {row["method"].split(" +")[0] for row in main} == SYSTEMS
    yono = [row["pose_free"] for row in main if row["method"] == "YoNoSplat" and row["group"] == "interp"]
    assert yono == [False, True]
    assert not any(row["method"] == "SPFSplat" for row in published.rows(views=4))
    assert [row["method"] for row in main][-1] == "QuerySplat + TTO-50"


def test_rows_follow_the_scales() -> None:
    def psnr(*scales: str, group: str = "interp") -> float:
        (row,) = (row for row in published.rows(scales, 4) if (row["method"], row["group"]) == ("QuerySplat", group))
        return float(row["psnr"])

    assert psnr("small") == 27.1912
    assert psnr("small", "large") == pytest.approx((27.1912 + 21.8724) / 2)
    assert psnr() == psnr("small", "medium", "large") == 24.5765
    assert psnr(group="extrap") == pytest.approx((23.2606 + 21.0778 + 19.6819) / 3)


def test_the_appendix_adds_up_to_the_main_table() -> None:
    """All 81 averages agree as far as rounding allows. A digit that is wrong would be reported."""
    assert published.disagreements() == []
    reported = published.disagreements(tolerance=0.0)
    assert any("the mean of the appendix is" in text for text in reported)
    assert all(re.search(r"(psnr|ssim|lpips): the main table has \d", text) for text in reported)


def test_a_wrong_digit_is_reported(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    content = json.loads(json.dumps({"tables": published.tables()}))
    (row,) = (
        row
        for table in content["tables"]
        for row in table["rows"]
        if table["label"] == "appendix-4views-small" and (row["method"], row["group"]) == ("QuerySplat", "interp")
    )
    row["psnr"] += 0.001
    monkeypatch.setattr(published, "_content", lambda: content)
    assert report() == 1
    assert "QuerySplat (pose-free), 4 views, psnr: the main table has 24.5765, the mean" in capsys.readouterr().out


def test_the_program_ends_with_its_finding(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["paper_tables.py"])
    with pytest.raises(SystemExit) as end:
        paper_tables.main()
    assert end.value.code == 0
    monkeypatch.setattr(published, "disagreements", lambda: ["a new one"])
    with pytest.raises(SystemExit) as end:
        paper_tables.main()
    assert end.value.code == 1
