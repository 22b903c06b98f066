"""What a scene is better without: Gaussians that no photo supports, small islands, and giants that none needs."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from torch import Tensor

from querysplat_cli.prune.gaussians import importance
from querysplat_cli.prune.policy import PRUNE_POLICY
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians


@dataclass(frozen=True)
class Unclean:
    """Which of N Gaussians a clean scene is without, by the first reason that applies."""

    unsupported: Bool[Tensor, "n"]
    giants: Bool[Tensor, "n"]
    islands: Bool[Tensor, "n"]

    @property
    def all(self) -> Bool[Tensor, "n"]:
        return self.unsupported | self.giants | self.islands

    def counts(self) -> dict[str, int]:
        return {name: int(part.sum()) for name, part in vars(self).items()}


def unclean(gaussians: Gaussians, cameras: Cameras | None) -> Unclean:
    """What `PrunePolicy.clean_*` say of a scene without its backdrop.

    unsupported: hardly changes any picture of `cameras`, nor of their surroundings; none where there are no cameras.
    giants: the longest axis is a large share of the scene's size, and the pictures of `cameras` change less than by
        half of the Gaussians.
    islands: few Gaussians that touch each other, and none of the rest.
    """
    policy, means = PRUNE_POLICY, gaussians.means
    unsupported = needed = torch.zeros(len(gaussians), dtype=torch.bool)
    if cameras is not None:
        influence = importance(gaussians, cameras)
        unsupported, needed = influence < policy.clean_influence, influence > influence.median()
    distance = (means - means.median(0).values).norm(dim=1)
    size = distance.kthvalue(max(1, round(policy.clean_extent * len(distance)))).values
    long = gaussians.scales.amax(1) > policy.clean_giant * distance.clamp_min(float(size))
    giants = long & ~needed & ~unsupported
    rest = ~(unsupported | giants)
    islands = torch.zeros_like(rest)
    islands[rest] = _islands(gaussians[rest])
    return Unclean(unsupported, giants, islands)


def _islands(gaussians: Gaussians) -> Bool[Tensor, "n"]:
    """Those in groups of fewer than a share of all. Two Gaussians touch where their ellipsoids' spheres do."""
    if len(gaussians) < 2:
        return torch.zeros(len(gaussians), dtype=torch.bool)
    means = gaussians.means.double().numpy()
    reach = PRUNE_POLICY.clean_reach * gaussians.scales.amax(1).double().numpy()
    neighbours = min(PRUNE_POLICY.clean_neighbours + 1, len(means))
    distance, other = cKDTree(means).query(means, k=neighbours)
    this = np.broadcast_to(np.arange(len(means))[:, None], other.shape)
    touching = distance <= reach[this] + reach[other]
    links = coo_array((np.ones(int(touching.sum())), (this[touching], other[touching])), shape=(len(means), len(means)))
    _, group = connected_components(links, directed=False)
    sizes = np.bincount(group)
    small = sizes < max(PRUNE_POLICY.clean_fewest, PRUNE_POLICY.clean_island * len(means))
    small[sizes.argmax()] = False
    return torch.from_numpy(small[group])
