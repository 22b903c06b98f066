"""Gaussians in the world of a similarity: centres, sizes, orientations, and the directions of their colours."""

import torch
from jaxtyping import Float
from torch import Tensor

from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.rotations import matrix_to_quaternion, quaternion_product
from querysplat_cli.scene.sim3 import Sim3
from querysplat_cli.splat.projection import basis

DIRECTIONS = 64
"""More than the 16 functions of degree 3, so that their values at these directions fix a rotation of them."""


def transform_gaussians(gaussians: Gaussians, similarity: Sim3) -> Gaussians:
    """The same scene in the world that `similarity` maps to. With cameras transformed alike, renders do not change."""
    rotation = similarity.rotation
    quats = quaternion_product(matrix_to_quaternion(rotation.double()), gaussians.quats.double())
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

    A rotated basis function is a weighted sum of those of its own degree. The weights solve a small least-squares
    problem whose residual is zero.
    """
    generator = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(DIRECTIONS, 3, generator=generator).double(), dim=1)
    here, there = basis(directions @ rotation), basis(directions)
    turned = [sh[:, :1]]
    start = 1
    while start < sh.shape[1]:
        stop = start + 2 * len(turned) + 1
        mixing = torch.linalg.lstsq(there[:, start:stop], here[:, start:stop]).solution
        turned.append(torch.einsum("ij,njc->nic", mixing, sh[:, start:stop]))
        start = stop
    return torch.cat(turned, 1)
