"""A stage that makes the photos look worse leaves the scene as it was, and the result says so."""

import pytest
from tto_scenes import photo_of_wall, wall

from querysplat_cli.runtime.choices import FullSizeLevel
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.tto.full_size import optimise_full_size
from querysplat_cli.tto.full_size_plan import FullSizePlan, FullSizeStage, Photos, plan_full_size
from querysplat_cli.tto.options import TtoSettings
from querysplat_cli.tto.rendering_loss import LossAndGradient, RenderingLoss

SIZE = 48


def test_a_stage_that_makes_photos_look_worse_is_not_kept() -> None:
    """The scene is what the photos show, and the step is far too long."""
    start = wall(12, size=1.2, opacity=0.97)
    wild = FullSizeStage(SIZE, TtoSettings(1, 8.0, views_per_step=1), len(start))
    found = optimise_full_size(start, photo_of_wall, FullSizePlan((wild,), 1.0), seed=0)
    assert found.not_kept == (SIZE,)
    assert found.runs[0][1].gaussians.means.equal(start.means)


def test_a_stage_that_improves_them_is() -> None:
    start = wall(4, size=1.2, opacity=0.97)
    good = FullSizeStage(SIZE, TtoSettings(10, 0.02, views_per_step=1), len(start))
    found = optimise_full_size(start, photo_of_wall, FullSizePlan((good,), 1.0), seed=0)
    assert found.not_kept == ()
    assert not found.runs[0][1].gaussians.means.equal(start.means)


def test_a_stage_that_ctrl_c_ended_before_its_first_step_made_nothing_worse(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(target: RenderingLoss, gaussians: Gaussians, chosen: list[int]) -> LossAndGradient:
        raise KeyboardInterrupt

    monkeypatch.setattr(RenderingLoss, "value_and_gradient", interrupt)
    start = wall(4, size=1.2, opacity=0.97)
    stage = FullSizeStage(SIZE, TtoSettings(10, 0.02, views_per_step=1), len(start))
    found = optimise_full_size(start, photo_of_wall, FullSizePlan((stage,), 1.0), seed=0)
    assert found.interrupted
    assert found.not_kept == ()


@pytest.mark.parametrize("level", ["standard", "high", "max"])
def test_a_finished_scene_never_sees_smaller_photos_again(level: FullSizeLevel) -> None:
    """Photos of 448 pixels took a scene made of 1,600 from 32.6 to 23.0 dB, and their own loss fell."""
    photos = Photos(11, 1200, 1600, 448)
    assert min(stage.max_size for stage in plan_full_size(level, photos, 300_000).stages) < 1600
    finished = plan_full_size(level, Photos(11, 1200, 1600, 448, reached=1600), 300_000)
    assert {stage.max_size for stage in finished.stages} == {1600}
