"""Gaussians transform_gaussians by a similarity: centres, sizes, orientations, and the directions of their colours."""

import torch
from jaxtyping import Float
from torch import Tensor

from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.sim3 import Sim3
from querysplat_cli.splat.projection import basis

DIRECTIONS = 64
"""More than the 16 functions of degree 3, so that their values at these directions fix a rotation of them."""


def transform_gaussians(gaussians: Gaussians, similarity: Sim3) -> Gaussians:
    """The same scene in the world that `similarity` maps to: a render from moved cameras is the render from before."""
    rotation = similarity.rotation
    quats = _times(_quaternion(rotation), gaussians.quats.double())
    bands = rotate_sh(gaussians.sh.double(), rotation)
    return Gaussians(
        similarity.apply(gaussians.means),
        quats.to(gaussians.quats.dtype),
        gaussians.scales * similarity.scale,
        gaussians.opacities,
        bands.to(gaussians.sh.dtype),
    )


def rotate_sh(sh: Float[Tensor, "n bands 3"], rotation: Float[Tensor, "3 3"]) -> Float[Tensor, "n bands 3"]:
    """Coefficients of the function that has at R·d the value that `sh` has at d, degree 0 to 3, float64.

    A rotated basis function is a sum of those of its own degree; the weights solve a small least-squares problem
    whose residual is zero.
    """
    generator = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(DIRECTIONS, 3, generator=generator).double(), dim=1)
    before, after = basis(directions @ rotation), basis(directions)
    turned = [sh[:, :1]]
    start = 1
    while start < sh.shape[1]:
        stop = start + 2 * len(turned) + 1
        mixing = torch.linalg.lstsq(after[:, start:stop], before[:, start:stop]).solution
        turned.append(torch.einsum("ij,njc->nic", mixing, sh[:, start:stop]))
        start = stop
    return torch.cat(turned, 1)


def _quaternion(rotation: Tensor) -> Tensor:
    """Unit quaternion w, x, y, z of a rotation matrix, stable for every angle (Bar-Itzhack 2000)."""
    r = rotation.double()
    xx, yy, zz = r[0, 0], r[1, 1], r[2, 2]
    symmetric = torch.stack(
        [
            torch.stack([xx + yy + zz, r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]]),
            torch.stack([r[2, 1] - r[1, 2], xx - yy - zz, r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]]),
            torch.stack([r[0, 2] - r[2, 0], r[0, 1] + r[1, 0], yy - xx - zz, r[1, 2] + r[2, 1]]),
            torch.stack([r[1, 0] - r[0, 1], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], zz - xx - yy]),
        ]
    )
    return torch.linalg.eigh(symmetric).eigenvectors[:, -1]


def _times(first: Tensor, second: Tensor) -> Tensor:
    """Hamilton product of w, x, y, z: the rotation `second`, then `first`."""
    a, b, c, d = first.unbind(-1)
    w, x, y, z = second.unbind(-1)
    return torch.stack(
        [
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        ],
        -1,
    )
