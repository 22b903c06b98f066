"""The parts of the program of quality against seconds that take no minutes: its clock and its figure."""

from pathlib import Path

import pytest
import torch

import tto_curves
from querysplat_cli.scene.gaussians import Gaussians


def some(count: int) -> Gaussians:
    return Gaussians(
        torch.zeros(count, 3), torch.ones(count, 4), torch.ones(count, 3), torch.ones(count), torch.zeros(count, 1, 3)
    )


def test_the_clock_stands_still_while_a_scene_is_scored(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 0.0
    monkeypatch.setattr("tto_curves.time.perf_counter", lambda: now)

    def measure(gaussians: Gaussians) -> float:
        nonlocal now
        now += 100
        return 20.0 + len(gaussians)

    watch = tto_curves.Watch(20, measure)
    watch.point(some(3))
    for step in range(20):
        watch.before_step(some(3 if step < 10 else 2))
        now += 1
    watch.point(some(1))
    assert [point["step"] for point in watch.points] == [0, 2, 4, 7, 10, 15, 20]
    assert [point["seconds"] for point in watch.points] == [0, 2, 4, 7, 10, 15, 20]
    assert [point["psnr"] for point in watch.points] == [23, 23, 23, 23, 22, 22, 21]


def test_sets_with_and_without_quoted_curves_are_drawn(tmp_path: Path) -> None:
    points = [{"step": step, "seconds": 2.0 * step, "psnr": 20.0 + step, "gaussians": 9} for step in range(3)]
    found = dict.fromkeys(("features", "gaussians", "both"), points)
    rows = [
        {"set": name, "use": "tuned on", "inputs": 5, "heldout": 2, "curves": found} for name in ("fortress", "fox")
    ]
    tto_curves.draw(rows, tmp_path / "curves.svg")
    assert "<svg" in (tmp_path / "curves.svg").read_text()
