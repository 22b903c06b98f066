"""Which Gaussians the difference from a photo is due to: a rendering, a derivative and blending weights in one pass."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.splat import cpu
from querysplat_cli.splat.blending_weights import blending_weights
from querysplat_cli.splat.conventions import RenderSettings
from querysplat_cli.splat.render import Rendering, refuse_broken, render, usual_splatter


@dataclass(frozen=True)
class Attribution:
    """One view of a scene beside its photo.

    residual: photo minus rendering, 0 outside of the mask.
    descent: minus the gradient of half the sum of squared residuals.
    weights: the blending weight of each Gaussian, summed over all pixels.
    """

    picture: Rendering
    residual: Float[Tensor, "3 height width"]
    descent: Gaussians
    weights: Float[Tensor, "n"]


def attribute(
    gaussians: Gaussians,
    camera: Cameras,
    photo: Float[Tensor, "3 height width"],
    mask: Bool[Tensor, "height width"],
    background: Float[Tensor, "3"],
) -> Attribution:
    """Render one view over the background, and attribute what differs from the photo.

    The CPU splatter does it in one pass, the others draw a second time for the weights. Raises QuerySplatError when a
    tensor holds NaN or Inf.
    """
    if usual_splatter(gaussians) == "cpu":
        return _in_one_pass(gaussians, camera, photo, mask, background)
    leaves = gaussians.map(lambda part: part.detach().requires_grad_())
    with torch.enable_grad():
        picture = render(leaves, camera, background=background)
        residual = (photo - picture.colour[0]) * mask
        loss = -0.5 * residual.square().sum()
        descent = torch.autograd.grad(loss, leaves.tensors(), materialize_grads=True)
    picture = Rendering(picture.colour.detach(), picture.alpha.detach(), picture.depth.detach())
    return Attribution(picture, residual.detach(), Gaussians(*descent), blending_weights(gaussians, camera))


def _in_one_pass(gaussians: Gaussians, camera: Cameras, photo: Tensor, mask: Tensor, background: Tensor) -> Attribution:
    refuse_broken(gaussians, camera)
    drawn = cpu.Drawn.of(gaussians, camera, RenderSettings())
    planes = drawn.planes[None]
    picture = Rendering.of(planes[:, :3], planes[:, 3], planes[:, 4], background)
    residual = (photo - picture.colour[0]) * mask
    of_alpha = -(residual * background[:, None, None]).sum(0, keepdim=True)
    return Attribution(picture, residual, *drawn.pull_back(torch.cat([residual, of_alpha])))
