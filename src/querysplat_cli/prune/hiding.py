"""Gaussians that no photo shows, and that hide what photos show.

Beyond its border, a photo is continued at the depth that it ends with. Where it ends on something near, the
continuation stands in the open space in front of what other photos show. It is in no photo, so no optimisation removes
it, and a camera between the photos looks through a fog.
"""

import torch
from jaxtyping import Bool
from torch import Tensor

from querysplat_cli.prune.policy import PRUNE_POLICY
from querysplat_cli.prune.views import evenly_spaced
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.paths import interpolate
from querysplat_cli.splat.blending_weights import blending_weights
from querysplat_cli.splat.render import render


@torch.no_grad()
def hiding(gaussians: Gaussians, cameras: Cameras) -> Bool[Tensor, "n"]:
    """Which Gaussians have their centres outside all photos and hide the others from cameras between neighbours.

    Such a Gaussian stands in front: it keeps more than `PrunePolicy.in_front` of the blending weight that it has
    without the others. And it hides them: more than `PrunePolicy.hidden_share` of that weight falls on what they cover
    without it. `cameras` are those of the photos; one photo has no neighbour.
    """
    shown = torch.zeros_like(gaussians.opacities, dtype=torch.bool)
    for view in range(len(cameras)):
        shown |= cameras.sees(gaussians.means, view)
    guessed, between = gaussians[~shown], _halfway(cameras)
    weight, alone, excess = torch.zeros(3, len(guessed)).to(gaussians.opacities)
    for view in range(len(between)):
        camera = between[[view]]
        covered = render(gaussians[shown], camera).alpha
        weight += blending_weights(gaussians, camera)[~shown]
        alone += blending_weights(guessed, camera)
        excess += blending_weights(gaussians, camera, covered - PRUNE_POLICY.hidden_share)[~shown]
    found = torch.zeros_like(shown)
    found[~shown] = (weight > PRUNE_POLICY.in_front * alone) & (excess > 0)
    return found


def _halfway(cameras: Cameras) -> Cameras:
    """At most `PrunePolicy.hiding_views` cameras between each of `cameras` and its nearest others, at half the size."""
    near = torch.cdist(cameras.centres, cameras.centres).argsort(dim=1, stable=True)
    pairs = {
        tuple(sorted((one, other)))
        for one, row in enumerate(near.tolist())
        for other in [view for view in row if view != one][: PRUNE_POLICY.hiding_neighbours]
    }
    some = evenly_spaced(sorted(pairs), PRUNE_POLICY.hiding_views)
    middle = [interpolate(cameras[list(pair)].to("cpu"), 3)[[1]] for pair in some]
    if not middle:
        return cameras[[]]
    w2c, K = (torch.cat([getattr(camera, name) for camera in middle]) for name in ("w2c", "K"))
    joined = Cameras(w2c, K, cameras.height, cameras.width).resized(cameras.height // 2, cameras.width // 2)
    return joined.to(cameras.w2c.device)
