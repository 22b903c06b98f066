"""How much each Gaussian counts in the pictures."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import SH_0, Gaussians
from querysplat_cli.splat import cpu
from querysplat_cli.splat.conventions import RenderSettings
from querysplat_cli.splat.render import refuse_broken, render, usual_splatter


def blending_weights(gaussians: Gaussians, cameras: Cameras) -> Float[Tensor, "n"]:
    """The blending weight of each Gaussian, summed over all pixels of all views.

    Views are looked at one after another, so that memory does not grow with their number.
    """
    total = torch.zeros_like(gaussians.opacities).detach()
    one = total.new_ones(1, cameras.height, cameras.width).expand(3, -1, -1)
    for view in range(len(cameras)):
        total += three_blending_weights(gaussians, cameras[[view]], one)[0]
    return total


def three_blending_weights(
    gaussians: Gaussians,
    camera: Cameras,
    pixel_weights: Float[Tensor, "3 height width"],
    settings: RenderSettings | None = None,
) -> Float[Tensor, "3 n"]:
    """`blending_weights` of one view, times each of three weights of the pixels, in one pass."""
    # In one colour: a picture's derivative by the flat colour of a Gaussian is that Gaussian's blending weight.
    flat = replace(gaussians.detach(), sh=torch.zeros_like(gaussians.sh[:, :1]).requires_grad_())
    if usual_splatter(flat) == "cpu":
        refuse_broken(flat, camera)
        return cpu.weigh(flat, camera, pixel_weights, settings or RenderSettings())
    with torch.enable_grad():
        weighted = render(flat, camera, settings=settings).colour[0] * pixel_weights
        (gradient,) = torch.autograd.grad(weighted.sum(), flat.sh)
    return gradient[:, 0].T / SH_0
