"""The curve of a training's log."""

import json
from math import inf, isnan, nan
from pathlib import Path

import numpy as np
import pytest

from querysplat_cli.training.journal import COLUMNS, CURVE_WINDOW, Journal, figures, running_mean


@pytest.mark.parametrize(("count", "left"), [(1, 1), (2, 2), (15, 11), (3 * CURVE_WINDOW, 2 * CURVE_WINDOW + 1)])
def test_a_short_log_has_a_curve_and_not_a_point(count: int, left: int) -> None:
    steps = np.arange(float(count))
    found = running_mean(steps)
    assert len(found) == left
    assert found.mean() == pytest.approx(steps.mean())


@pytest.mark.parametrize("count", [0, 3])
def test_a_figure_that_is_not_finite_is_null(count: int, tmp_path: Path) -> None:
    """The file is JSON for any reader, a line of it counts when a training goes on, and curves leave it out."""
    journal = Journal(tmp_path, 0, tensorboard=False)
    for step in range(1, count + 1):
        journal.add({**dict.fromkeys(COLUMNS, 0.5), "step": step, "pictures": 0.25})
    journal.add({**dict.fromkeys(COLUMNS, 0.5), "step": 9, "loss": nan, "psnr": -inf})
    last = json.loads((tmp_path / "log.jsonl").read_text().splitlines()[-1], parse_constant=pytest.fail)
    assert (last["loss"], last["psnr"], last["lr"]) == (None, None, 0.5)
    journal = Journal(tmp_path, 9, tensorboard=False)
    assert [row["step"] for row in journal.rows()] == [*range(1, count + 1), 9]
    assert isnan((journal.last() or {})["loss"])
    for name in ("loss", "pictures"):
        assert [len(part) for part in figures(journal.rows(), name)] == [count, count]
    journal.draw()
    assert (tmp_path / "curve.png").is_file()


@pytest.mark.parametrize(
    "damaged", [b"7", b"null", b"[1]", b"{}", b'{"step": 2', b'{"step": "2"}', b'{"step": 2}', b"\xff\x00", b"[" * 9999]
)
def test_a_damaged_line_is_left_out(damaged: bytes, tmp_path: Path) -> None:
    rows = [dict.fromkeys(COLUMNS, step) for step in (1, 3, 5)]
    first, second, later = (json.dumps(row).encode() for row in rows)
    (tmp_path / "log.jsonl").write_bytes(b"\n".join([first, damaged, second, later]) + b"\n")
    journal = Journal(tmp_path, 3, tensorboard=False)
    assert journal.rows() == rows[:2]
    journal.draw()
    assert (tmp_path / "curve.png").is_file()
