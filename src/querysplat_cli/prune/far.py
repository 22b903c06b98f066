"""Far and giant Gaussians are drawn in, so that a few of them do not decide how large a scene is.

Viewers frame the box of all Gaussians, with some standard deviations around each.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from querysplat_cli.prune.policy import PRUNE_POLICY
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians


def drawn_in(gaussians: Gaussians, cameras: Cameras) -> Gaussians:
    """The farthest Gaussians, moved towards the middle of the cameras and made smaller by the same factor.

    From there they look as before, and their order in depth stays. The others, a share of `PrunePolicy.near_share`,
    stay where they are. None is then farther away than `PrunePolicy.farthest` times the farthest of these. Giants,
    which reach beyond `PrunePolicy.reach` times that distance with two standard deviations, become smaller. A second
    time changes nothing.
    """
    centre = cameras.centres.mean(0)
    near = _near((gaussians.means - centre).norm(dim=1))
    if near == 0:
        return gaussians
    return _without_giants(_nearer(gaussians, centre, near), centre, near)


def largest_scales(means: Float[Tensor, "n 3"], cameras: Cameras) -> Float[Tensor, "n"]:
    """The standard deviation, in scene units, beyond which `drawn_in` takes a Gaussian with such a centre for a giant.

    Where the centre is one of the farthest, it is that of the place that it is drawn in to at most. Infinite where all
    centres are the cameras' middle.
    """
    distance = (means - cameras.centres.mean(0)).norm(dim=1)
    near = _near(distance)
    if near == 0:
        return torch.full_like(distance, torch.inf)
    return _largest(distance.clamp_max(PRUNE_POLICY.farthest * near), near)


def _near(distance: Float[Tensor, "n"]) -> Float[Tensor, ""]:
    """The distance from the middle of the farthest Gaussian that stays where it is."""
    return distance.kthvalue(max(1, round(PRUNE_POLICY.near_share * len(distance)))).values


def _largest(distance: Tensor, near: Float[Tensor, ""]) -> Tensor:
    return (PRUNE_POLICY.reach * near - distance) / 2


def _nearer(gaussians: Gaussians, centre: Float[Tensor, "3"], near: Float[Tensor, ""]) -> Gaussians:
    arms = gaussians.means - centre
    distance = arms.norm(dim=1)
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


def _without_giants(gaussians: Gaussians, centre: Float[Tensor, "3"], near: Float[Tensor, ""]) -> Gaussians:
    distance = (gaussians.means - centre).norm(dim=1, keepdim=True)
    largest = _largest(distance, near)
    if bool((gaussians.scales <= largest * (1 + 1e-4)).all()):
        return gaussians
    return replace(gaussians, scales=torch.minimum(gaussians.scales, largest))
