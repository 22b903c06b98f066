"""Coarser levels of detail: pairs of Gaussians that resemble each other become one, until half of them are left.

The mass of a Gaussian is its opacity times the surface of its ellipsoid, which is four times the area that it covers
on average over all directions. Merging two costs the smaller mass, as far as they differ: a faint or small one is taken
up by a neighbour first, and equal neighbours next. One that stands for two has their mass, centre, covariance and SH.
"""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from querysplat_cli.prune.policy import PRUNE_POLICY
from querysplat_cli.scene.gaussians import SH_0, Gaussians, joined
from querysplat_cli.scene.rotations import matrix_to_quaternion, quaternion_to_matrix
from querysplat_cli.splat.conventions import RenderSettings

THINNEST = 0.1
"""Where two Gaussians are compared, axes count as at least this share of the longest. Few flat ones share a plane."""


def halved(gaussians: Gaussians, leaf: Int[Tensor, "n"]) -> tuple[Gaussians, Int[Tensor, "m"]]:
    """Half of the Gaussians of each leaf, rounded up, and the leaf of each. Both are in the order of the leaves.

    `leaf` numbers them from 0. Only Gaussians of one leaf are merged. The result does not depend on the order of
    other leaves' Gaussians.
    """
    order = torch.argsort(leaf, stable=True)
    counts = torch.bincount(leaf).tolist()
    parts = [_merged_to(gaussians[rows], -(-len(rows) // 2)) for rows in order.split(counts)]
    sizes = torch.tensor([len(part) for part in parts])
    return joined(*parts), torch.repeat_interleave(torch.arange(len(parts)), sizes)


def _merged_to(gaussians: Gaussians, count: int) -> Gaussians:
    """At most so many Gaussians as `count`, in float32."""
    while len(gaussians) > count:
        pairs = _cheapest_pairs(gaussians, len(gaussians) - count)
        alone = torch.ones(len(gaussians), dtype=torch.bool)
        alone[pairs.flatten()] = False
        gaussians = joined(gaussians[alone], _merged(gaussians[pairs[:, 0]], gaussians[pairs[:, 1]]))
    return gaussians


def _cheapest_pairs(gaussians: Gaussians, most: int) -> Int[Tensor, "pairs 2"]:
    """At most so many pairs of neighbours, each of which is the cheapest one of both; at least one."""
    neighbours = min(PRUNE_POLICY.lod_neighbours + 1, len(gaussians))
    _, other = cKDTree(gaussians.means.double().numpy()).query(gaussians.means.double().numpy(), k=neighbours)
    this = np.repeat(np.arange(len(gaussians)), neighbours)
    ends = np.stack([np.minimum(this, other.ravel()), np.maximum(this, other.ravel())], 1)
    ends = np.unique(ends[ends[:, 0] < ends[:, 1]], axis=0)
    ends = ends[np.argsort(_costs(gaussians, torch.from_numpy(ends)).numpy(), kind="stable")]
    rank = np.arange(len(ends))
    best = np.full(len(gaussians), len(ends))
    np.minimum.at(best, ends[:, 0], rank)
    np.minimum.at(best, ends[:, 1], rank)
    mutual = (best[ends[:, 0]] == rank) & (best[ends[:, 1]] == rank)
    return torch.from_numpy(ends[mutual][:most])


def _costs(gaussians: Gaussians, ends: Int[Tensor, "pairs 2"]) -> Float[Tensor, "pairs"]:
    """Smaller mass times 1 − exp(−d); d is the Bhattacharyya distance of the ellipsoids and that of the colours."""
    scales = gaussians.scales.double()
    thick = replace(gaussians, scales=scales.maximum(THINNEST * scales.amax(1, keepdim=True)).clamp_min(1e-12))
    mass, covariances = _mass(gaussians), _covariances(thick)
    volume = thick.scales.log().sum(1)
    first, second = ends.unbind(1)
    mean = (covariances[first] + covariances[second]) / 2
    apart = (gaussians.means[first] - gaussians.means[second]).double()
    inverse, determinant = _inverse(mean)
    far = torch.einsum("ni,nij,nj->n", apart, inverse, apart) / 8
    shape = (determinant.log() - volume[first] - volume[second]) / 2
    colour = SH_0 * (gaussians.sh[first, 0] - gaussians.sh[second, 0]).double().norm(dim=1)
    difference = far + shape.clamp_min(0) + (colour / PRUNE_POLICY.lod_colour).square() / 2
    return mass[first].minimum(mass[second]) * -torch.expm1(-difference)


def _merged(one: Gaussians, other: Gaussians) -> Gaussians:
    masses = torch.stack([_mass(one), _mass(other)])
    share, rest = (masses / masses.sum(0)).unbind(0)
    apart = (other.means - one.means).double()
    spread = (share * rest)[:, None, None] * apart[:, :, None] * apart[:, None, :]
    covariances = share[:, None, None] * _covariances(one) + rest[:, None, None] * _covariances(other) + spread
    variances, axes = torch.linalg.eigh(covariances)
    axes = axes * torch.where(torch.linalg.det(axes) < 0, -1.0, 1.0)[:, None, None]
    merged = Gaussians(
        one.means + rest[:, None] * apart,
        matrix_to_quaternion(axes),
        variances.clamp_min(1e-24).sqrt(),
        torch.ones(len(one)),
        share[:, None, None] * one.sh + rest[:, None, None] * other.sh,
    )
    # Where both lie on each other, their opacities add up no further than one behind the other.
    behind = 1 - (1 - one.opacities.double()) * (1 - other.opacities.double())
    opacities = (masses.sum(0) / _surface(merged)).minimum(behind).clamp(1e-8, RenderSettings().alpha_max)
    return replace(merged, opacities=opacities).to(torch.float32)


def _mass(gaussians: Gaussians) -> Float[Tensor, "n"]:
    return gaussians.opacities.double() * _surface(gaussians)


def _surface(gaussians: Gaussians) -> Float[Tensor, "n"]:
    """Of the ellipsoids, up to a factor and a few percent."""
    a, b, c = gaussians.scales.double().unbind(1)
    return (a * b + b * c + c * a).clamp_min(1e-30)


def _covariances(gaussians: Gaussians) -> Float[Tensor, "n 3 3"]:
    quats = gaussians.quats.double()
    # Other programs may have written quaternions of zeros, which stand for no rotation.
    identity = quats.new_tensor([1.0, 0.0, 0.0, 0.0])
    axes = quaternion_to_matrix(torch.where(quats.any(1)[:, None], quats, identity))
    axes = axes * gaussians.scales.double()[:, None, :]
    return axes @ axes.mT


def _inverse(matrices: Float[Tensor, "n 3 3"]) -> tuple[Float[Tensor, "n 3 3"], Float[Tensor, "n"]]:
    """Of symmetric matrices, with their determinants; LAPACK's takes several times as long."""
    a, b, c = matrices.unbind(1)
    cofactors = torch.stack([torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)], 1)
    determinant = (a * cofactors[:, 0]).sum(1).clamp_min(1e-300)
    return cofactors / determinant[:, None, None], determinant
