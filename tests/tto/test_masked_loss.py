"""What a photo shows where it is masked changes neither the loss nor its gradient."""

from dataclasses import replace

import torch
from tto_scenes import wall

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.views import Views
from querysplat_cli.tto.rendering_loss import RenderingLoss

SIDE = 48


def test_masked_pixels_take_no_part() -> None:
    K = torch.tensor([[40.0, 0, 24], [0, 40, 24], [0, 0, 1]])[None]
    cameras = Cameras(torch.eye(4)[None], K, SIDE, SIDE)
    image = torch.rand(1, 3, SIDE, SIDE, generator=torch.Generator().manual_seed(0))
    masks = torch.ones(1, SIDE, SIDE, dtype=torch.bool)
    masks[0, 10:30, 5:40] = False
    views = Views(image, masks, ("0.png",), ((SIDE, SIDE),))
    other = replace(views, images=torch.where(masks[:, None], image, 1 - image))
    gaussians = wall(8, size=0.3, opacity=0.8)
    one, two = (RenderingLoss(each, cameras) for each in (views, other))
    assert one.value(gaussians, [0]) == two.value(gaussians, [0])
    assert one.psnr(gaussians, [0]) == two.psnr(gaussians, [0])
    slopes, theirs = (each.value_and_gradient(gaussians, [0]) for each in (one, two))
    for slope, other_slope in zip(slopes.gradient.tensors(), theirs.gradient.tensors(), strict=True):
        torch.testing.assert_close(slope, other_slope)
    whole = replace(views, masks=torch.ones_like(masks))
    assert RenderingLoss(whole, cameras).value(gaussians, [0]) != one.value(gaussians, [0])
