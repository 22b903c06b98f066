"""Ctrl-C outside the steps: what was reached is kept."""

from collections.abc import Callable

import pytest
import torch
from tto_scenes import photo_of_wall, wall

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.views import Views
from querysplat_cli.tto.coverage_loss import CoverageLoss
from querysplat_cli.tto.full_size import FullSizeResult, optimise_full_size
from querysplat_cli.tto.full_size_plan import FullSizePlan, FullSizeStage
from querysplat_cli.tto.gaussians import optimise_gaussians
from querysplat_cli.tto.options import TtoSettings
from querysplat_cli.tto.rendering_loss import RenderingLoss

SMALL, LARGE = 36, 72


def stopped(ask: Callable[[int], tuple[Views, Cameras]] = photo_of_wall) -> FullSizeResult:
    stages = [FullSizeStage(size, TtoSettings(10, 0.02, views_per_step=1), 16) for size in (SMALL, LARGE)]
    return optimise_full_size(start(), ask, FullSizePlan(tuple(stages), 1.0), seed=0)


def start() -> Gaussians:
    return wall(4, size=1.2, opacity=0.97)


def interrupts_at(monkeypatch: pytest.MonkeyPatch, call: int) -> None:
    """Ctrl-C comes in this evaluation of all views; a stage has one before its steps, and one after them."""
    calls, values = 0, RenderingLoss.values

    def counted(target: RenderingLoss, gaussians: Gaussians, chosen: list[int]) -> list[float]:
        nonlocal calls
        calls += 1
        if calls == call:
            raise KeyboardInterrupt
        return values(target, gaussians, chosen)

    monkeypatch.setattr(RenderingLoss, "values", counted)


def test_while_photos_are_read() -> None:
    """Before the first stage, the caller has the scene."""

    def ask(wanted: int) -> tuple[Views, Cameras]:
        if wanted == size:
            raise KeyboardInterrupt
        return photo_of_wall(wanted)

    size = LARGE
    found = stopped(ask)
    assert found.interrupted
    assert len(found.runs) == 1
    assert not found.gaussians.means.equal(start().means)
    size = SMALL
    with pytest.raises(KeyboardInterrupt):
        stopped(ask)


@pytest.mark.parametrize(
    ("call", "steps"), [(1, [0]), (2, [10]), (3, [10, 0])], ids=["before the first step", "after the last", "between"]
)
def test_while_all_photos_are_compared(monkeypatch: pytest.MonkeyPatch, call: int, steps: list[int]) -> None:
    """A stage that took its steps keeps them."""
    interrupts_at(monkeypatch, call)
    found = stopped()
    assert found.interrupted
    assert [len(result.history) for _, result in found.runs] == steps
    assert found.gaussians.means.equal(start().means) == (steps == [0])
    assert found.not_kept == ()


def test_while_the_coverage_between_a_few_photos_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    """The scene from before the steps is kept, as it is while all photos are compared."""

    def interrupt(gaussians: Gaussians, cameras: Cameras) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(CoverageLoss, "of", interrupt)
    target, settings = RenderingLoss(*photo_of_wall(SMALL)), TtoSettings(10, 0.02, keep_cover=True)
    found = optimise_gaussians(start(), target, settings, generator=torch.Generator())
    assert found.interrupted
    assert found.history == ()
    assert found.gaussians.means.equal(start().means)
