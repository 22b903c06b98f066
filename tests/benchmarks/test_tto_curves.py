"""The parts of the program of quality against seconds that take no minutes: its clock, its figure and its runs."""

from pathlib import Path

import pytest
import torch

import densify
import tto_curves
from common import builds
from common.photo_sets import PHOTO_SETS
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.reporting.view_scores import score
from querysplat_cli.scene.gaussians import Gaussians
from training_scenes import TINY, sample


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


@pytest.mark.slow
def test_a_curve_ends_with_the_scene_of_reconstruct() -> None:
    """Photos of other exposures get transforms, and Gaussians in between are handed to the clock."""
    torch.manual_seed(0)
    model, given = QuerySplat(TINY).requires_grad_(False), sample(1, inputs=3)
    given.views.images[1] *= 0.5
    points = tto_curves.curves(model, given, 10)["features"]
    scene = builds.build(model, given, tto=10).gaussians
    assert [point["step"] for point in points] == [0, 1, 2, 4, 5, 8, 10]
    assert points[-1]["psnr"] == score(scene, given.targets, given.target_cameras).psnr
    assert points[-1]["gaussians"] == len(scene)


@pytest.mark.slow
def test_gaussians_are_split_with_the_transforms_of_the_photos(monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)
    model, given = QuerySplat(TINY).requires_grad_(False), sample(1, inputs=3)
    given.views.images[1] *= 0.5
    optimise, transforms = densify.optimise_gaussians, []
    monkeypatch.setattr(
        densify,
        "optimise_gaussians",
        lambda start, target, *rest, **options: (
            transforms.append(target.exposures) or optimise(start, target, *rest, **options)
        ),
    )
    start = builds.build(model, given, tto=2)
    densify.further(PHOTO_SETS["fox"], start, given, densify.Run(2, 1.0, 1))
    assert start.exposures
    assert transforms != [None]
