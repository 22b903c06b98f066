"""Progress without a terminal."""

import time

import pytest

from querysplat_cli.cli.progress_lines import ProgressLines, time_left
from querysplat_cli.runtime.progress import Stages


@pytest.mark.parametrize(
    ("elapsed", "fraction", "left"),
    [(10.0, 0.5, "10 s left"), (600.0, 0.1, "90 min left"), (5.0, 0.0, ""), (5.0, 0.001, ""), (5.0, 1.0, "")],
)
def test_the_time_left(elapsed: float, fraction: float, left: str) -> None:
    assert time_left(elapsed, fraction) == left


def test_a_line_for_each_stage_and_one_now_and_then() -> None:
    said: list[str] = []
    with ProgressLines(said.append, quiet_seconds=0.2) as lines:
        stages = Stages(lines.show)
        with stages("photos"):
            pass
        with stages("tto") as progress:
            progress("loss 0.5", 0.25)
            time.sleep(0.7)
        with stages("score"):  # reports nothing
            time.sleep(0.5)
    time.sleep(0.4)
    assert [line for line in said if not line.startswith(" ")] == ["photos", "tto", "score"]
    about_tto = [line for line in said if line.startswith("  tto: 25%")]
    assert 1 <= len(about_tto) <= 4
    assert "loss 0.5" in about_tto[0]
    assert " left" in about_tto[0]
    assert any(line.startswith("  score: ") for line in said)


def test_many_reports_are_not_many_lines() -> None:
    said: list[str] = []
    with ProgressLines(said.append) as lines:
        stages = Stages(lines.show)
        with stages("tto") as progress:
            for step in range(1000):
                progress(f"step {step}", step / 1000)
    assert said == ["tto"]
