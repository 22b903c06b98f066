"""The 3D smoothing filter of Mip-Splatting (Yu et al. 2024, arXiv:2311.16493, section 5.1): no detail below a pixel.

Photos say nothing of detail that is finer than their pixels. A Gaussian that is thinner than a pixel of the finest
photo was never seen as thin as that. From nearer by it is a needle or a crack, from farther away it flickers. The
filter convolves every Gaussian with one of variance v/rate², where the rate is focal length over depth, the largest
over the photos that see the Gaussian.
"""

from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians


@dataclass(frozen=True)
class SmoothingPolicy:
    """How thin a Gaussian may be."""

    variance: float = 0.1
    """The least variance of a Gaussian along any axis, in px² of the finest photo that sees it. The paper has 0.2, and
    another 0.1 in its splatter, where other splatters add 0.3. Chosen on fortress and fox: at 448 pixels 0.2 gains as
    much PSNR, but is less sharp (SSIM 0.004 and 0.002 lower)."""
    margin: float = 0.15
    """A photo sees what lies in its frustum, widened on each side by this share of the picture. The value is that of
    the paper's authors."""


SMOOTHING_POLICY = SmoothingPolicy()


@torch.no_grad()
def least_scales(means: Float[Tensor, "n 3"], cameras: Cameras) -> Float[Tensor, "n"]:
    """The filter's standard deviation √v/rate for each Gaussian, in scene units: what it makes of a point.

    Other Gaussians in front do not count. A Gaussian that no photo of `cameras` sees is sampled as if the nearest
    camera were turned to it.
    """
    seen = torch.full_like(means[:, 0], torch.inf)
    unseen = torch.full_like(seen, torch.inf)
    fx, fy, cx, cy = cameras.intrinsics
    for view, centre in enumerate(cameras.centres):
        x, y, z = cameras.local(means, view).unbind(1)
        focal = torch.maximum(fx[view], fy[view])
        inside = (z > 0) & _within(x * fx[view], z, cx[view], cameras.width)
        inside &= _within(y * fy[view], z, cy[view], cameras.height)
        seen = torch.minimum(seen, torch.where(inside, z / focal, torch.inf))
        unseen = torch.minimum(unseen, (means - centre).norm(dim=1) / focal)
    return SMOOTHING_POLICY.variance**0.5 * torch.where(seen.isfinite(), seen, unseen)


def convolved(gaussians: Gaussians, cameras: Cameras) -> Gaussians:
    """The Gaussians after the filter: scales √(s² + l²) with l of `least_scales`, and opacities that fall accordingly.

    Opacity times volume, the integral of the density over space, stays the same. Differentiable, but for l.
    """
    least = least_scales(gaussians.means.detach(), cameras)
    return _rescaled(gaussians, (gaussians.scales.square() + least[:, None].square()).sqrt())


def bounded(gaussians: Gaussians, cameras: Cameras) -> Gaussians:
    """Scales of at least `least_scales`, the least that the filter can give; opacities as in `convolved`.

    Gaussians that went through the filter stay as they are, and applying this twice changes nothing.
    """
    return _rescaled(gaussians, torch.maximum(gaussians.scales, least_scales(gaussians.means, cameras)[:, None]))


def held(scales: Float[Tensor, "n 3"], least: Float[Tensor, "n"], largest: Float[Tensor, "n"]) -> Float[Tensor, "n 3"]:
    """Scales within bounds, for optimisation: one beyond a bound still gets the gradient that takes it back.

    Where the bounds contradict each other, `least` holds.
    """
    within: Tensor = _Held.apply(scales, least[:, None], torch.maximum(least, largest)[:, None])
    return within


class _Held(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, least: Tensor, largest: Tensor) -> Tensor:
        ctx.save_for_backward(values > least, values < largest)
        return values.clamp(least, largest)

    @staticmethod
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor, None, None]:
        may_shrink, may_grow = ctx.saved_tensors
        return torch.where(torch.where(slope > 0, may_shrink, may_grow), slope, 0), None, None


def _rescaled(gaussians: Gaussians, scales: Float[Tensor, "n 3"]) -> Gaussians:
    shares = (gaussians.scales / scales.clamp_min(torch.finfo(scales.dtype).tiny)).prod(1)
    return replace(gaussians, scales=scales, opacities=gaussians.opacities * shares)


def _within(x: Tensor, z: Tensor, middle: Tensor, size: int) -> Bool[Tensor, "n"]:
    """Whether x/z + middle lies on the picture widened by the margin, without a division by zero."""
    margin = SMOOTHING_POLICY.margin * size
    return (x >= (-margin - middle) * z) & (x <= (size + margin - middle) * z)
