"""Optimisation makes no Gaussian thinner than the pixels of the photos, and none as large as the scene."""

from dataclasses import replace

import pytest
import torch
from tto_scenes import wall

from querysplat_cli.prune.far import largest_scales
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians, joined
from querysplat_cli.scene.views import Views
from querysplat_cli.splat.render import render
from querysplat_cli.splat.smoothing import least_scales
from querysplat_cli.tto.full_size import optimise_full_size
from querysplat_cli.tto.full_size_plan import FullSizePlan, FullSizeStage
from querysplat_cli.tto.gaussians import optimise_gaussians
from querysplat_cli.tto.options import TtoSettings
from querysplat_cli.tto.rendering_loss import LossAndGradient, RenderingLoss
from querysplat_cli.tto.scale_bounds import bounding

SIZE = 48


def photos(size: int = SIZE) -> tuple[Views, Cameras]:
    """Three photos of a wall of coloured spots."""
    w2c = torch.eye(4).repeat(3, 1, 1)
    w2c[:, 0, 3] = torch.tensor([-0.1, 0.0, 0.1])
    K = torch.tensor([[1.0 * size, 0, size / 2], [0, 1.0 * size, size / 2], [0, 0, 1]]).repeat(3, 1, 1)
    cameras = Cameras(w2c, K, size, size)
    images = render(wall(10, size=0.5, opacity=0.95), cameras).colour.clamp(0, 1)
    masks = torch.ones(3, size, size, dtype=torch.bool)
    return Views(images, masks, ("a", "b", "c"), ((size, size),) * 3), cameras


def thinnest(gaussians: Gaussians, cameras: Cameras) -> float:
    """The least scale relative to its bound; at least 1 where all keep it."""
    return float((gaussians.scales.amin(1) / least_scales(gaussians.means, cameras)).min())


def solid() -> RenderingLoss:
    return RenderingLoss.for_solid_scenes(*photos(), torch.Generator().manual_seed(0))


def test_needles_become_as_thick_as_pixels() -> None:
    needles = wall(10, size=0.9, opacity=0.5)
    needles = replace(needles, scales=needles.scales * torch.tensor([1.0, 1e-3, 1e-3]))
    settings, target = TtoSettings(25, 0.02), solid()

    def run(target: RenderingLoss) -> Gaussians:
        return optimise_gaussians(needles, target, settings, generator=torch.Generator().manual_seed(0)).gaussians

    free, bounded = run(replace(target, finest=None)), run(target)
    assert thinnest(free, target.cameras) < 0.1
    # Centres move a little after their sampling was found.
    assert thinnest(bounded, target.cameras) > 0.98


def test_the_halves_of_split_gaussians_keep_the_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    _, cameras = photos()
    small = wall(10, size=1.0, opacity=0.9)
    small = replace(small, scales=1.05 * least_scales(small.means, cameras)[:, None].expand(-1, 3))
    rendered: list[Gaussians] = []
    plain = RenderingLoss.value_and_gradient

    def noted(target: RenderingLoss, gaussians: Gaussians, chosen: list[int]) -> LossAndGradient:
        rendered.append(gaussians.detach())
        # Without a gradient, Gaussians change by splitting alone.
        found = plain(target, gaussians, chosen)
        return replace(found, gradient=found.gradient.map(torch.zeros_like))

    monkeypatch.setattr(RenderingLoss, "value_and_gradient", noted)
    generator = torch.Generator().manual_seed(0)
    for target in (solid(), replace(solid(), finest=None)):
        optimise_gaussians(small, target, TtoSettings(8, 0.01), generator=generator, densify_to=400)
    bounded, free = rendered[:8], rendered[8:]
    assert len(bounded[-1]) == len(free[-1]) == 400
    assert min(thinnest(each, cameras) for each in bounded) > 0.99
    assert thinnest(free[-1], cameras) < 0.95


def test_the_sampling_follows_gaussians_that_move() -> None:
    """Gaussians that come half as near to the camera may be half as thin."""
    _, cameras = photos()
    far = wall(4, size=1e-4, opacity=0.5)
    decode = bounding(unchanged, cameras)
    first = decode(far).scales
    near = replace(far, means=0.5 * far.means)
    for _ in range(40):
        last = decode(near).scales
    torch.testing.assert_close(last, first / 2, rtol=1e-4, atol=0)


def test_centres_that_are_not_finite_leave_no_trace() -> None:
    _, cameras = photos()
    some = wall(4, size=1e-4, opacity=0.5)
    decode = bounding(unchanged, cameras)
    decode(replace(some, means=torch.full_like(some.means, torch.nan)))
    assert bool(decode(some).scales.isfinite().all())
    assert bounding(unchanged, None) is unchanged


def unchanged(gaussians: Gaussians) -> Gaussians:
    return gaussians


@pytest.mark.parametrize("size", [SIZE, 2 * SIZE])
def test_large_photos_bound_the_scales_by_their_own_pixels(size: int) -> None:
    stage = FullSizeStage(size, TtoSettings(6, 0.01, views_per_step=1), 100)
    thin = replace(wall(10, size=0.9, opacity=0.5), scales=torch.full((100, 3), 1e-4))
    result = optimise_full_size(thin, photos, FullSizePlan((stage,), 0.0), seed=0)
    assert thinnest(result.gaussians, photos(size)[1]) >= 1 - 1e-6
    assert thinnest(result.gaussians, photos(SIZE)[1]) < 1.2 * SIZE / size


def test_far_gaussians_that_are_drawn_in_are_no_thinner_than_pixels() -> None:
    """They become smaller on the way, so the bound comes last."""
    near = wall(20, size=0.9, opacity=0.5)
    far = replace(near[:2], means=torch.tensor([[0.0, 0, 300], [0, 0, 400]]), scales=torch.full((2, 3), 1e-4))
    stage = FullSizeStage(SIZE, TtoSettings(3, 0.01, views_per_step=1), 500)
    result = optimise_full_size(joined(far, near), photos, FullSizePlan((stage,), 0.0), seed=0)
    assert float(result.gaussians.means.norm(dim=1).max()) < 100
    assert thinnest(result.gaussians, photos(SIZE)[1]) >= 1 - 1e-6


def test_a_scene_that_wants_giants_still_fits_its_photos_when_it_is_done() -> None:
    """A plain wall wants large Gaussians. Giants would become smaller at the end, and leave holes between them."""
    views, cameras = photos()
    views = replace(views, images=torch.full_like(views.images, 0.8))
    few = replace(wall(3, size=1.2, opacity=0.1), sh=torch.zeros(9, 1, 3))
    stage = FullSizeStage(SIZE, TtoSettings(120, 0.05, views_per_step=1), 9)
    result = optimise_full_size(few, lambda size: (views, cameras), FullSizePlan((stage,), 0.0), seed=0)
    reached = result.runs[0][1]
    grey = RenderingLoss.for_solid_scenes(views, cameras, torch.Generator())
    assert grey.value(result.gaussians, [0, 1, 2]) < 1.01 * grey.value(reached.gaussians, [0, 1, 2])
    assert (reached.gaussians.scales <= 1.01 * largest_scales(reached.gaussians.means, cameras)[:, None]).all()


def test_a_split_draws_far_gaussians_in_while_others_can_adapt() -> None:
    near = wall(20, size=0.9, opacity=0.5)
    far = replace(near[:2], means=torch.tensor([[0.0, 0, 300], [0, 0, 400]]))
    generator = torch.Generator().manual_seed(0)
    result = optimise_gaussians(joined(far, near), solid(), TtoSettings(8, 0.01), generator=generator, densify_to=500)
    assert float(result.gaussians.means.norm(dim=1).max()) < 100
