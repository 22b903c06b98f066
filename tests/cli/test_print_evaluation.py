"""The tables of `querysplat eval` on a terminal of 80 letters."""

from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from querysplat_cli.cli import terminal
from querysplat_cli.cli.print_evaluation import print_evaluation
from querysplat_cli.cli.verb import Printing

NAMES = [f"free_max_size{size}_queries{queries}_qualitystandard_depth" for size in (224, 448) for queries in (9, 90000)]


def average(row: str, group: str, views: int) -> dict[str, Any]:
    figures = {"psnr": 23.456, "ssim": 0.789, "lpips": None, "seconds_median": 123.4, "gaussians_median": 71234.0}
    return {"row": row, "group": group, "views": views, "scored": 120, "asked": 124, "failed": 3, **figures}


@pytest.fixture
def summary() -> dict[str, Any]:
    groups = ("input", "interpolation", "extrapolation")
    quoted = {"views": 4, "method": "QuerySplat", "group": "input", "psnr": 1.0, "ssim": 0.1, "lpips": 0.2}
    averages = [average(name, group, views) for views in (2, 4) for name in NAMES for group in groups]
    return {"averages": averages, "quoted": {"rows": [quoted]}, "lpips": [], "failures": []}


def test_rows_of_a_sweep_can_be_told_apart(
    summary: dict[str, Any], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Every name stands whole in one line, no figure is cut, and no line is longer than the terminal."""
    monkeypatch.setattr(terminal, "console", Console(width=80))
    print_evaluation(summary, Path("out"), Printing())
    lines = [line.rstrip() for line in capsys.readouterr().out.splitlines()]
    assert max(map(len, lines)) <= 80
    assert [line for line in lines if line in NAMES] == NAMES * 2
    figures = "23.46  0.789  –      120 of 124  3       123.4    71,234"
    assert sum(line.split(maxsplit=1)[1:] == [figures] for line in lines) == 24
    assert not any("…" in line for line in lines)
    assert lines.count("4 views") == lines.count("2 views") == 1
    assert [line for line in lines if "QuerySplat" in line]
