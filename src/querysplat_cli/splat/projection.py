"""Gaussians projected into the picture plane: in plain torch, in the precision of the tensors."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import SH_0, SH_1, SH_2, SH_3, Gaussians
from querysplat_cli.scene.rotations import quaternion_to_matrix
from querysplat_cli.splat.conventions import (
    CLAMP_MARGIN,
    COLOUR_LIMIT,
    SCALE_LIMIT,
    SHORTEST_QUATERNION,
    RenderSettings,
)


@dataclass(frozen=True)
class Projected:
    """One view's Gaussians: `centre` in pixels, `conic` = inverse 2D covariance (xx, xy, yy) in px⁻², camera z,
    colour, opacity. Rows that are not `visible` hold arbitrary finite numbers and pass no gradient on."""

    centre: Float[Tensor, "n 2"]
    conic: Float[Tensor, "n 3"]
    depth: Float[Tensor, "n"]
    colour: Float[Tensor, "n 3"]
    opacity: Float[Tensor, "n"]
    visible: Bool[Tensor, "n"]


def project_gaussians(gaussians: Gaussians, camera: Cameras, settings: RenderSettings) -> Projected:
    """EWA projection (Zwicker 2001), as in 3DGS, into the one view of `camera`.

    It is relative to the camera centre, so that scenes far from the origin keep their detail. Culled are Gaussians
    with z outside [near, far], opacity below alpha_min, a quaternion of length 0, or scales that are not positive or
    overflow.
    """
    w2c = camera.w2c[0]
    rotation = w2c[:3, :3]
    centre = -(rotation.T @ w2c[:3, 3])
    offset = gaussians.means - centre
    visible = _valid(gaussians, settings)
    local = offset @ rotation.T
    visible = visible & (local[:, 2] >= settings.near) & (local[:, 2] <= settings.far)
    # Culled rows are replaced before any division: a NaN that a mask only hides would still spoil the gradient.
    ahead = torch.tensor([0.0, 0.0, 1.0], dtype=local.dtype)
    local = torch.where(visible[:, None], local, ahead)
    offset = torch.where(visible[:, None], offset, ahead)
    quats = torch.where(visible[:, None], gaussians.quats, torch.tensor([1.0, 0, 0, 0], dtype=local.dtype))
    scales = torch.where(visible[:, None], gaussians.scales, torch.ones((), dtype=local.dtype))
    x, y, z = local.unbind(1)
    fx, fy, cx, cy = (part[0] for part in camera.intrinsics)
    slope_x = _limit(x / z, cx, fx, camera.width)
    slope_y = _limit(y / z, cy, fy, camera.height)
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        [torch.stack([fx / z, zero, -fx * slope_x / z], 1), torch.stack([zero, fy / z, -fy * slope_y / z], 1)], 1
    )
    axes = jacobian @ rotation @ quaternion_to_matrix(quats) * scales[:, None, :]
    first, second = axes[:, 0], axes[:, 1]
    low_pass = settings.low_pass
    xx, yy = first.square().sum(1) + low_pass, second.square().sum(1) + low_pass
    xy = (first * second).sum(1)
    # |first × second|² is det(axes·axesᵀ) without the cancellation of xx·yy − xy² (Cauchy–Binet).
    det = torch.linalg.cross(first, second).square().sum(1) + low_pass * (xx + yy - low_pass)
    return Projected(
        centre=torch.stack([fx * x / z + cx, fy * y / z + cy], 1),
        conic=torch.stack([yy / det, -xy / det, xx / det], 1),
        depth=z,
        colour=colours(gaussians.sh, torch.nn.functional.normalize(offset, dim=1)),
        opacity=gaussians.opacities,
        visible=visible,
    )


def colours(sh: Float[Tensor, "n bands 3"], directions: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """max(0, 0.5 + Σ sh·basis) for unit directions from the camera to the Gaussian, degree 0 to 3."""
    weights = basis(directions)[:, : sh.shape[1]]
    return (0.5 + (weights[..., None] * sh).sum(1)).clamp(0, COLOUR_LIMIT)


def basis(directions: Float[Tensor, "n 3"]) -> Float[Tensor, "n 16"]:
    """Real spherical harmonics of unit directions, degree 0 to 3, in the 3DGS order and sign."""
    x, y, z = directions.unbind(1)
    one = torch.ones_like(x)
    return torch.stack(
        [
            SH_0 * one,
            -SH_1 * y,
            SH_1 * z,
            -SH_1 * x,
            SH_2[0] * x * y,
            SH_2[1] * y * z,
            SH_2[2] * (2 * z * z - x * x - y * y),
            SH_2[3] * x * z,
            SH_2[4] * (x * x - y * y),
            SH_3[0] * y * (3 * x * x - y * y),
            SH_3[1] * x * y * z,
            SH_3[2] * y * (4 * z * z - x * x - y * y),
            SH_3[3] * z * (2 * z * z - 3 * x * x - 3 * y * y),
            SH_3[4] * x * (4 * z * z - x * x - y * y),
            SH_3[5] * z * (x * x - y * y),
            SH_3[6] * x * (x * x - 3 * y * y),
        ],
        1,
    )


def _valid(gaussians: Gaussians, settings: RenderSettings) -> Tensor:
    return (
        (gaussians.opacities >= settings.alpha_min)
        & (torch.linalg.vector_norm(gaussians.quats.double(), dim=1) >= SHORTEST_QUATERNION)
        & (gaussians.scales > 0).all(1)
        & (gaussians.scales < SCALE_LIMIT).all(1)
    )


def _limit(slope: Tensor, middle: Tensor, focal: Tensor, size: int) -> Tensor:
    """The slope x/z or y/z held inside the widened frustum, whose sides depend on the principal point."""
    margin = CLAMP_MARGIN * size / (2 * focal)
    return torch.minimum(torch.maximum(slope, -middle / focal - margin), (size - middle) / focal + margin)
