"""Optimisation makes no Gaussian thinner than the pixels of the photos."""

from dataclasses import replace

import pytest
import torch
from tto_scenes import wall

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.views import Views
from querysplat_cli.splat.render import render
from querysplat_cli.splat.smoothing import sampling
from querysplat_cli.tto.densify import densify
from querysplat_cli.tto.full_size import optimise_full_size
from querysplat_cli.tto.full_size_plan import FullSizePlan, FullSizeStage
from querysplat_cli.tto.gaussians import optimise_gaussians
from querysplat_cli.tto.options import TtoSettings
from querysplat_cli.tto.rendering_loss import RenderingLoss
from querysplat_cli.tto.smoothing import with_bounded_scales
from querysplat_cli.tto.variables import Denser, Parametrisation

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
    return float((gaussians.scales.amin(1) / sampling(gaussians.means, cameras).least).min())


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


def test_the_halves_of_split_gaussians_keep_the_bound() -> None:
    views, cameras = photos()
    small = wall(10, size=0.19, opacity=0.9)
    assert 1 < thinnest(small, cameras) < 1.1  # just above the bound, so that halves would be below it

    def halve(some: Gaussians, target: RenderingLoss, rounds: int) -> Denser[Gaussians]:
        more = densify(some, target, 2 * len(some))
        assert thinnest(more.gaussians, cameras) < 0.95
        return Denser(more.gaussians, lambda each: each, more.origin)

    start = with_bounded_scales(Parametrisation(small, lambda some: some, {}, halve), cameras)
    assert start.densify
    denser = start.densify(small, RenderingLoss(views, cameras), 1)
    halves = denser.decode(denser.variables)
    assert len(halves) == 200
    assert thinnest(halves, cameras) >= 1 - 1e-6


def test_the_sampling_follows_gaussians_that_move() -> None:
    """Gaussians that come half as near to the camera may be half as thin."""
    _, cameras = photos()
    far = wall(4, size=1e-4, opacity=0.5)
    start = Parametrisation(far, lambda some: some, {})
    decode = with_bounded_scales(start, cameras).decode
    first = decode(far).scales
    near = replace(far, means=far.means * torch.tensor([0.5, 0.5, 0.5]))
    for _ in range(40):
        last = decode(near).scales
    torch.testing.assert_close(last, first / 2)


def test_centres_that_are_not_finite_leave_no_trace() -> None:
    _, cameras = photos()
    some = wall(4, size=1e-4, opacity=0.5)
    decode = with_bounded_scales(Parametrisation(some, lambda each: each, {}), cameras).decode
    decode(replace(some, means=torch.full_like(some.means, torch.nan)))
    assert bool(decode(some).scales.isfinite().all())


@pytest.mark.parametrize("size", [SIZE, 2 * SIZE])
def test_large_photos_bound_the_scales_by_their_own_pixels(size: int) -> None:
    stage = FullSizeStage(size, TtoSettings(6, 0.01, views_per_step=1), 100)
    thin = replace(wall(10, size=0.9, opacity=0.5), scales=torch.full((100, 3), 1e-4))
    result = optimise_full_size(thin, photos, FullSizePlan((stage,), 0.0), seed=0)
    assert thinnest(result.gaussians, photos(size)[1]) >= 1 - 1e-6
    assert thinnest(result.gaussians, photos(SIZE)[1]) < 1.2 * SIZE / size
