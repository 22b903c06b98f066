"""Camera refinement during optimisation."""

from dataclasses import replace

import pytest
import torch

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.sim3 import align_cameras
from querysplat_cli.scene.views import Views
from querysplat_cli.splat.render import render
from querysplat_cli.tto.cameras import RefinedCameras, refinable, with_refined_focal
from querysplat_cli.tto.gaussians import optimise_gaussians
from querysplat_cli.tto.options import TtoSettings
from querysplat_cli.tto.rendering_loss import RenderingLoss

SIZE = 64


def scene() -> tuple[Gaussians, Views, Cameras]:
    """A scene, its photos, and the cameras of the photos, on an arc."""
    random = torch.Generator().manual_seed(0)
    count = 120
    gaussians = Gaussians(
        means=torch.rand(count, 3, generator=random) * torch.tensor([1.2, 1.2, 0.6]) + torch.tensor([-0.6, -0.6, 1.4]),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        scales=torch.full((count, 3), 0.05),
        opacities=torch.full((count,), 0.9),
        sh=torch.randn(count, 1, 3, generator=random),
    )
    w2c = torch.eye(4).repeat(4, 1, 1)
    w2c[:, 0, 3] = torch.tensor([-0.4, -0.1, 0.2, 0.4])
    w2c[:, 1, 3] = torch.tensor([0.1, -0.2, 0.2, -0.1])
    K = torch.tensor([[80.0, 0, SIZE / 2], [0, 80.0, SIZE / 2], [0, 0, 1]]).repeat(4, 1, 1)
    cameras = Cameras(w2c, K, SIZE, SIZE)
    images = render(gaussians, cameras).colour.clamp(0, 1)
    masks = torch.ones(4, SIZE, SIZE, dtype=torch.bool)
    return gaussians, Views(images, masks, ("a", "b", "c", "d"), ((SIZE, SIZE),) * 4), cameras


def turned(cameras: Cameras, pixels: float) -> Cameras:
    """Each camera rotated at random, by about so many pixels about each axis."""
    turns = torch.randn(len(cameras), 3, generator=torch.Generator().manual_seed(1)) * pixels / cameras.K[0, 0, 0]
    skew = torch.linalg.cross(turns[:, None].expand(-1, 3, 3), torch.eye(3).expand(len(cameras), 3, 3), dim=2)
    w2c = cameras.w2c.clone()
    w2c[:, :3] = torch.linalg.matrix_exp(skew) @ w2c[:, :3]
    return replace(cameras, w2c=w2c)


def pixels_off(cameras: Cameras, true: Cameras, gaussians: Gaussians) -> float:
    """Mean distance in pixels of the projected centres, after a similarity to the cameras `true`."""
    same = cameras.transformed(align_cameras(cameras.w2c, true.w2c))

    def seen(some: Cameras) -> torch.Tensor:
        local = torch.einsum("vij,nj->vni", some.w2c[:, :3, :3], gaussians.means) + some.w2c[:, None, :3, 3]
        image = torch.einsum("vij,vnj->vni", some.K, local)
        return image[..., :2] / image[..., 2:]

    return float((seen(same) - seen(true)).norm(dim=-1).mean())


def test_wrong_cameras_are_put_right() -> None:
    gaussians, views, true = scene()
    wrong = turned(true, 1.0)
    random = torch.Generator().manual_seed(2)
    start = gaussians.map(torch.Tensor.clone)
    start = replace(start, means=start.means + 0.01 * torch.randn(start.means.shape, generator=random))
    found = {
        refine: optimise_gaussians(
            start,
            RenderingLoss(views, wrong),
            TtoSettings(80, 0.02, views_per_step=3),
            generator=torch.Generator().manual_seed(0),
            refine_cameras=refine,
        )
        for refine in (False, True)
    }
    assert found[False].cameras is wrong
    before, after = (pixels_off(some, true, gaussians) for some in (wrong, found[True].cameras))
    assert before > 0.8
    assert after < before / 3
    assert found[True].loss_after < 0.6 * found[False].loss_after
    # The world has not moved: no similarity is left between the cameras before and after.
    left = align_cameras(found[True].cameras.w2c, wrong.w2c)
    torch.testing.assert_close(left.rotation, torch.eye(3).double(), atol=1e-5, rtol=0)
    torch.testing.assert_close(left.translation, torch.zeros(3).double(), atol=1e-5, rtol=0)
    assert abs(left.scale - 1) < 1e-5


def test_a_wrong_focal_length_is_put_right_and_held_out_cameras_follow() -> None:
    gaussians, views, true = scene()
    K = true.K.clone()
    K[:, :, :2] *= 1.03
    wrong = replace(true, K=K)
    result = optimise_gaussians(
        gaussians,
        RenderingLoss(views, wrong),
        TtoSettings(60, 1e-6),
        generator=torch.Generator().manual_seed(0),
        refine_cameras=True,
    )
    focal = float(result.cameras.K[0, 0, 0])
    assert abs(focal - 80) < 0.4 * abs(82.4 - 80)
    torch.testing.assert_close(with_refined_focal(wrong[[0]], wrong, result.cameras).K, result.cameras.K[:1])


def test_a_run_that_ends_no_better_keeps_the_cameras() -> None:
    gaussians, views, true = scene()
    target = RenderingLoss(views, true)
    perfect = TtoSettings(3, 1e-3)
    result = optimise_gaussians(
        gaussians, target, perfect, generator=torch.Generator().manual_seed(0), refine_cameras=True
    )
    assert result.cameras is true


def test_going_back_takes_the_cameras_to_the_mark_and_slows_them() -> None:
    """Otherwise the scene of an earlier step would have the cameras of a later one."""
    gaussians, views, true = scene()
    refined = RefinedCameras(turned(true, 1.0), gaussians)
    leaves = gaussians.map(lambda field: field.clone().requires_grad_())

    def step() -> float:
        before = refined.current()
        replace(RenderingLoss(views, true), cameras=before).value_and_gradient(leaves, [0, 1, 2, 3]).send_back(
            leaves, before
        )
        refined.step(1.0)
        return float((refined.current().w2c - before.w2c).detach().abs().max())

    marked = []
    for _ in range(3):
        marked.append(refined.current().w2c.detach())
        refined.mark()
        moved = step()
    refined.go_back()
    torch.testing.assert_close(refined.current().w2c.detach(), marked[1], atol=1e-7, rtol=0)
    assert step() < 0.8 * moved


def test_an_undone_step_takes_the_cameras_back() -> None:
    gaussians, views, true = scene()
    refined = RefinedCameras(turned(true, 1.0), gaussians)
    leaves = gaussians.map(lambda field: field.clone().requires_grad_())
    for seen in ([0, 1, 2, 3], [0, 2]):
        before = refined.current()
        target = replace(RenderingLoss(views, true), cameras=before)
        target.value_and_gradient(leaves, seen).send_back(leaves, before)
        refined.step(1.0)
    moved = (refined.current().w2c - before.w2c).abs().amax((1, 2))
    # The gauge may move cameras whose views the step did not render, but less.
    assert moved[[0, 2]].min() > 2 * moved[[1, 3]].max()
    refined.undo()
    torch.testing.assert_close(refined.current().w2c, before.w2c, atol=0, rtol=0)


def test_one_camera_cannot_be_refined() -> None:
    gaussians, _, true = scene()
    assert refinable(true)
    assert not refinable(true[[0]])
    with pytest.raises(QuerySplatError, match="cannot be refined"):
        RefinedCameras(true[[0]], gaussians)


def test_gradients_of_a_step_that_split_move_no_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    """A split takes the place of a step, and the next step is of other views."""
    moved = []
    step = RefinedCameras.step

    def noted(refined: RefinedCameras, share: float) -> None:
        moved.append(sum(pose.grad is not None and bool(pose.grad.any()) for pose in refined._poses))
        step(refined, share)

    monkeypatch.setattr(RefinedCameras, "step", noted)
    gaussians, views, true = scene()
    settings = TtoSettings(3, 1e-3, views_per_step=1, densify_after=(0.0,))
    target = RenderingLoss(views, turned(true, 1.0))
    generator = torch.Generator().manual_seed(0)
    optimise_gaussians(
        gaussians, target, settings, generator=generator, refine_cameras=True, densify_to=len(gaussians) + 5
    )
    assert moved == [1, 1]
