"""Far Gaussians are drawn in, so that a few of them do not decide how large a scene is."""

from dataclasses import replace

import torch

from querysplat_cli.prune.policy import PRUNE_POLICY
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians


def drawn_in(gaussians: Gaussians, cameras: Cameras) -> Gaussians:
    """The farthest Gaussians, moved towards the middle of the cameras and made smaller by the same factor.

    From there they look as before, and their order in depth stays. The others, a share of `PrunePolicy.near_share`, do
    not change. None is then farther away than `PrunePolicy.farthest` times the farthest of these. A second time
    changes nothing.
    """
    centre = cameras.centres.mean(0)
    arms = gaussians.means - centre
    distance = arms.norm(dim=1)
    near = distance.kthvalue(max(1, round(PRUNE_POLICY.near_share * len(distance)))).values
    room = (PRUNE_POLICY.farthest - 1) * near
    beyond = (distance - near).clamp_min(0)
    excess = beyond.max() - room
    if excess <= 1e-4 * room:  # rounding of an earlier time
        return gaussians
    # Rises like `beyond` at first, and then ever more slowly up to `room`.
    drawn = room * beyond * beyond.max() / (room * beyond.max() + excess * beyond)
    factor = torch.where(beyond > 0, (near + drawn) / distance, 1.0)[:, None]
    return replace(
        gaussians,
        means=torch.where(beyond[:, None] > 0, centre + factor * arms, gaussians.means),
        scales=factor * gaussians.scales,
    )
