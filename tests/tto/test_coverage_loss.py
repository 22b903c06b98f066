"""The coverage loss keeps optimisation from opening holes between photos that are far apart."""

from dataclasses import replace

import pytest
import torch

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.views import Views
from querysplat_cli.splat.render import render
from querysplat_cli.tto.coverage_loss import CoverageLoss
from querysplat_cli.tto.gaussians import optimise_gaussians
from querysplat_cli.tto.options import TtoSettings
from querysplat_cli.tto.plan import plan_tto
from querysplat_cli.tto.policy import TTO_POLICY
from querysplat_cli.tto.rendering_loss import LossAndGradient, RenderingLoss

SIZE = 32


def wall(dtype: torch.dtype = torch.float32) -> Gaussians:
    """Grey discs, side by side, wider than two pictures."""
    x, y = torch.meshgrid(torch.linspace(-1.2, 1.2, 17), torch.linspace(-0.6, 0.6, 9), indexing="ij")
    means = torch.stack([x.ravel(), y.ravel(), torch.full((x.numel(),), 1.5)], 1).to(dtype)
    return Gaussians(
        means,
        torch.tensor([1.0, 0, 0, 0], dtype=dtype).repeat(len(means), 1),
        torch.full((len(means), 3), 0.09, dtype=dtype),
        torch.full((len(means),), 0.8, dtype=dtype),
        torch.zeros(len(means), 4, 3, dtype=dtype),
    )


def two(dtype: torch.dtype = torch.float32) -> Cameras:
    """Two cameras whose pictures show parts of the wall that do not touch."""
    w2c = torch.eye(4, dtype=dtype).repeat(2, 1, 1)
    w2c[:, 0, 3] = torch.tensor([0.7, -0.7])
    K = torch.tensor([[45.0, 0, SIZE / 2], [0, 45.0, SIZE / 2], [0, 0, 1]], dtype=dtype).repeat(2, 1, 1)
    return Cameras(w2c, K, SIZE, SIZE)


def nothing(gaussians: Gaussians) -> LossAndGradient:
    return LossAndGradient([0.0], 0.0, gaussians.map(torch.zeros_like))


def lost(coverage_loss: CoverageLoss, gaussians: Gaussians) -> float:
    with torch.no_grad():
        return float((coverage_loss.alphas - render(gaussians, coverage_loss.cameras).alpha).relu().mean())


def test_the_cameras_lie_between_the_views() -> None:
    coverage_loss = CoverageLoss.of(wall(), two())
    torch.testing.assert_close(coverage_loss.cameras.centres[:, 0], torch.tensor([-0.35, 0.0, 0.35]))
    assert len(CoverageLoss.of(wall(), two()[[0, 1, 0]]).cameras) == 2 * TTO_POLICY.cameras_between


def test_a_scene_that_covers_as_much_is_left_alone() -> None:
    coverage_loss = CoverageLoss.of(wall(), two())
    wider = replace(wall(), scales=1.3 * wall().scales)
    for scene in (wall(), wider):
        gradient = coverage_loss.add_to(nothing(scene), scene, 0).gradient
        assert all(float(part.abs().max()) < 1e-6 for part in (gradient.opacities, gradient.scales, gradient.means))


def test_the_gradient_is_that_of_the_lost_coverage() -> None:
    before = wall(torch.float64)
    coverage_loss = CoverageLoss.of(before, two(torch.float64))
    thin = replace(before, opacities=0.5 * before.opacities)
    one = 1 + 7 * 9

    def loss(opacity: float) -> float:
        opacities = thin.opacities.clone()
        opacities[one] = opacity
        alpha = render(replace(thin, opacities=opacities), coverage_loss.cameras[[1]]).alpha[0]
        return TTO_POLICY.coverage_weight * float((coverage_loss.alphas[1] - alpha).relu().mean())

    added = replace(nothing(thin), gradient=thin.map(torch.ones_like))
    found = coverage_loss.add_to(added, thin, 1 + 2 * TTO_POLICY.cameras_between).gradient.opacities[one] - 1
    assert float(found) < 0
    assert float(found) == pytest.approx((loss(0.4 + 1e-6) - loss(0.4 - 1e-6)) / 2e-6, rel=1e-6)


def test_optimisation_opens_no_hole_where_no_photo_shows_the_scene() -> None:
    scene, cameras = wall(), two()
    thin = replace(scene, scales=0.6 * scene.scales)
    masks = torch.ones(2, SIZE, SIZE, dtype=torch.bool)
    views = Views(render(thin, cameras).colour.clamp(0, 1), masks, ("a.png", "b.png"), ((SIZE, SIZE),) * 2)
    target, coverage_loss = RenderingLoss(views, cameras), CoverageLoss.of(scene, cameras)
    free, held = (
        optimise_gaussians(
            scene,
            target,
            TtoSettings(40, 0.03, keep_cover=keep),
            generator=torch.Generator().manual_seed(0),
        )
        for keep in (False, True)
    )
    assert held.loss_after < 0.5 * held.loss_before
    assert lost(coverage_loss, held.gaussians) < 0.5 * lost(coverage_loss, free.gaussians)


def test_a_few_views_keep_their_cover() -> None:
    kept = {
        views: plan_tto(10, views=views, gaussians=100)[0].settings.keep_cover
        for views in range(1, TTO_POLICY.few_views + 2)
    }
    assert [views for views, keep in kept.items() if keep] == list(range(2, TTO_POLICY.few_views + 1))


def test_an_automatic_plan_bounds_the_passes_over_a_few_photos() -> None:
    for views in range(1, TTO_POLICY.few_views + 1):
        (run,) = plan_tto(None, views=views, gaussians=100)
        assert (
            TTO_POLICY.passes - 1
            < run.settings.steps * min(views, TTO_POLICY.views_per_step) / views
            <= TTO_POLICY.passes
        )
    more, many = (
        plan_tto(None, views=views, gaussians=100)[0].settings.steps for views in (TTO_POLICY.few_views + 1, 100)
    )
    assert more == many > TTO_POLICY.passes * TTO_POLICY.few_views / TTO_POLICY.views_per_step
    assert plan_tto(90, views=2, gaussians=100)[0].settings.steps == 90
