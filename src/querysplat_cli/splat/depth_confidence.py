"""How far a rendered depth can be trusted."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import SH_0, Gaussians
from querysplat_cli.splat.render import Rendering, render

HALF_TRUSTED = 0.05
"""Relative standard deviation of a pixel's depth at which its confidence is half of its coverage."""


@torch.no_grad()
def depth_confidence(gaussians: Gaussians, camera: Cameras, picture: Rendering) -> Float[Tensor, "height width"]:
    """From 0 to 1, for `picture` of one view: the coverage, less where Gaussians at several depths are blended.

    A second rendering gives the mean square of the depth, in place of a colour.
    """
    z = camera.local(gaussians.means, 0)[:, 2].clamp_min(0)
    ahead = z[z > 0]
    unit = float(ahead.median()) if len(ahead) else 1.0
    squares = ((z / unit).square() - 0.5) / SH_0
    drawn = render(replace(gaussians, sh=squares[:, None, None].repeat(1, 1, 3)), camera)
    mean_square = unit**2 * drawn.colour[0, 0] / drawn.alpha[0].clamp_min(1e-10)
    depth, alpha = picture.depth[0], picture.alpha[0]
    relative = (mean_square / depth.square().clamp_min(1e-20) - 1).clamp_min(0)
    return torch.where(alpha > 0, alpha / (1 + relative / HALF_TRUSTED**2), 0.0)
