"""LPIPS as a part of the optimisation's loss: its weight and its gradient."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from tto_scenes import wall

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.views import Views
from querysplat_cli.tto.policy import TTO_POLICY
from querysplat_cli.tto.rendering_loss import RenderingLoss

SIZE = 24


def distance(picture: Tensor, photo: Tensor) -> Tensor:
    """Stands for LPIPS."""
    return (picture - photo).square().mean()


def target() -> RenderingLoss:
    """Two photos of noise; the right half of the second one is outside of its mask."""
    K = torch.tensor([[20.0, 0, SIZE / 2], [0, 20, SIZE / 2], [0, 0, 1]]).repeat(2, 1, 1)
    masks = torch.ones(2, SIZE, SIZE, dtype=torch.bool)
    masks[1, :, SIZE // 2 :] = False
    images = torch.rand(2, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(1))
    views = Views(images, masks, ("a", "b"), ((SIZE, SIZE),) * 2)
    return RenderingLoss(views, Cameras(torch.eye(4).repeat(2, 1, 1), K, SIZE, SIZE))


def test_the_distance_joins_the_loss_by_its_weight() -> None:
    """Its values and its gradient are those of the plain loss plus 0.05 of its own, inside the masks."""
    gaussians, plain = wall(6, size=0.5, opacity=0.8), target()
    whole = replace(plain, perceptual=distance)
    leaves = gaussians.map(lambda field: field.detach().requires_grad_())
    added = []
    for view in range(2):
        picture = plain.render(leaves, view).colour
        inside = torch.where(plain.views.masks[[view]][:, None], picture, plain.views.images[[view]])
        added.append(TTO_POLICY.lpips * distance(inside, plain.views.images[[view]]))
    sum(added).div(2).backward()  # type: ignore[union-attr]
    without, found = plain.value_and_gradient(gaussians, [0, 1]), whole.value_and_gradient(gaussians, [0, 1])
    for view in range(2):
        extra = float(added[view].detach())
        assert extra > 1e-3
        assert found.losses[view] == pytest.approx(without.losses[view] + extra, rel=1e-5)
        assert whole.values(gaussians, [view])[0] == pytest.approx(found.losses[view], rel=1e-5)
    torch.testing.assert_close(found.gradient.means, without.gradient.means + leaves.means.grad)
    torch.testing.assert_close(found.gradient.sh, without.gradient.sh + leaves.sh.grad)
    assert found.psnr == without.psnr


def test_losses_that_are_compared_have_one_background() -> None:
    """Gradients are over random colours, which would make the curve and the undo test jump."""
    grey = torch.full((3,), 0.5)
    faint = replace(target(), background=grey, backgrounds=torch.Generator().manual_seed(0), perceptual=distance)
    gaussians = wall(6, size=0.5, opacity=0.2)
    values = faint.values(gaussians, [0, 1])
    for _ in range(3):
        assert faint.value_and_gradient(gaussians, [0, 1]).losses == pytest.approx(values, rel=1e-6)
