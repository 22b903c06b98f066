"""The 3D smoothing filter of Mip-Splatting (Yu et al. 2024, arXiv:2311.16493, section 5.1): no detail below a pixel.

Photos say nothing of detail that is finer than their pixels. A Gaussian that is thinner than a pixel of the finest
photo was never seen as thin as that. From nearer by it is a needle or a crack, from farther away it flickers. So the
pixels bound how thin a Gaussian may be.

The paper convolves: scales become √(s² + v/rate²), where rate is focal length over depth, the largest over the photos
that see the Gaussian. The scales that this can give are those of at least √v/rate. Here that bound itself is
applied. Gaussians above it stay as they are, and applying it twice changes nothing, so a stored scene can be taken
further.
"""

from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.rotations import quaternion_to_matrix


@dataclass(frozen=True)
class SmoothingPolicy:
    """How thin a Gaussian may be."""

    variance: float = 0.2
    """The least variance of a Gaussian along any axis, in px² of the finest photo that sees it. The value is the
    paper's."""
    margin: float = 0.15
    """A photo sees what lies in its frustum, widened on each side by this share of the picture. The value is that of
    the paper's authors."""


SMOOTHING_POLICY = SmoothingPolicy()


@dataclass(frozen=True)
class Sampling:
    """How finely photos sample each of N Gaussians.

    least: the least standard deviation that the photos can show, in scene units.
    towards: the unit vector from the camera of the finest photo to the Gaussian.
    """

    least: Float[Tensor, "n"]
    towards: Float[Tensor, "n 3"]


@torch.no_grad()
def sampling(means: Float[Tensor, "n 3"], cameras: Cameras) -> Sampling:
    """The sampling by the photos of `cameras`, whether other Gaussians hide the Gaussian or not.

    A Gaussian that no photo sees is sampled as if the nearest camera were turned to it.
    """
    seen = torch.full_like(means[:, 0], torch.inf)
    unseen = torch.full_like(seen, torch.inf)
    nearest, finest = torch.zeros(2, len(means), dtype=torch.long, device=means.device)
    fx, fy, cx, cy = cameras.intrinsics
    for view, centre in enumerate(cameras.centres):
        x, y, z = (means @ cameras.w2c[view, :3, :3].T + cameras.w2c[view, :3, 3]).unbind(1)
        focal = torch.maximum(fx[view], fy[view])
        inside = (z > 0) & _within(x * fx[view], z, cx[view], cameras.width)
        inside &= _within(y * fy[view], z, cy[view], cameras.height)
        pixel = torch.where(inside, z / focal, torch.inf)
        finest[pixel < seen] = view
        seen = torch.minimum(seen, pixel)
        away = (means - centre).norm(dim=1) / focal
        nearest[away < unseen] = view
        unseen = torch.minimum(unseen, away)
    chosen = torch.where(seen.isfinite(), finest, nearest)
    pixel = torch.where(seen.isfinite(), seen, unseen)
    towards = torch.nn.functional.normalize(means - cameras.centres[chosen], dim=1)
    return Sampling(SMOOTHING_POLICY.variance**0.5 * pixel, towards)


def smoothed(gaussians: Gaussians, cameras: Cameras) -> Gaussians:
    """Scales of at least `Sampling.least`, with opacities that keep what each Gaussian adds to the finest photo.

    The integral of α over a picture is opacity times the area of the projected Gaussian. The opacity falls as the area
    grows. The paper divides by the growth of the volume instead. That would make a thin disc transparent that its
    photo shows from the front, where the disc covers as much as before.
    """
    found = sampling(gaussians.means, cameras)
    scales = torch.maximum(gaussians.scales, found.least[:, None])
    shares = projected_areas(gaussians, found.towards) / projected_areas(
        replace(gaussians, scales=scales), found.towards
    ).clamp_min(torch.finfo(scales.dtype).tiny)
    return replace(gaussians, scales=scales, opacities=gaussians.opacities * shares.clamp_max(1))


def projected_areas(gaussians: Gaussians, towards: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """The root of the determinant of the covariance in the plane perpendicular to the unit vector `towards`.

    With the vector's components u along the axes, its square is Σ sⱼ²sₖ²uᵢ² over the three axes i and the others j, k.
    """
    along = (quaternion_to_matrix(gaussians.quats) * towards[:, :, None]).sum(1)
    across = gaussians.scales[:, [1, 2, 0]] * gaussians.scales[:, [2, 0, 1]]
    return (across * along).norm(dim=1)


def hold_above(scales: Float[Tensor, "n 3"], least: Float[Tensor, "n"]) -> Float[Tensor, "n 3"]:
    """max(scales, least), for optimisation: a scale below the bound still gets the gradient that enlarges it."""
    held: Tensor = _Held.apply(scales, least[:, None])
    return held


class _Held(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, least: Tensor) -> Tensor:
        ctx.save_for_backward(values > least)
        return torch.maximum(values, least)

    @staticmethod
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor, None]:
        (free,) = ctx.saved_tensors
        return torch.where(free | (slope < 0), slope, 0), None


def _within(x: Tensor, z: Tensor, middle: Tensor, size: int) -> Bool[Tensor, "n"]:
    """Whether x/z + middle lies on the picture widened by the margin, without a division by zero."""
    margin = SMOOTHING_POLICY.margin * size
    return (x >= (-margin - middle) * z) & (x <= (size + margin - middle) * z)
