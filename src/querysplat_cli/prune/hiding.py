"""Gaussians that hide what photos show, and that no two photos agree on.

Beyond its border, a photo is continued at the depth that it ends with. What a single photo shows has a guessed depth,
too. Where such a guess stands in the open space in front of what other photos show, no optimisation removes it, because
no photo looks through it, and a camera beside the photos looks through a fog.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Bool
from torch import Tensor

from querysplat_cli.prune.policy import PRUNE_POLICY
from querysplat_cli.runtime.sequences import evenly_spaced
from querysplat_cli.scene.cameras import Cameras, nearest_first
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.paths import on_the_line
from querysplat_cli.splat.blending_weights import blending_weights, three_blending_weights
from querysplat_cli.splat.render import render

BESIDE_SCALE = 0.5
"""Of the pictures that are looked at between and beside the photos."""


@torch.no_grad()
def hiding(
    gaussians: Gaussians, cameras: Cameras, sizes: Sequence[tuple[int, int]] | None = None, *, harm: float = 0.0
) -> Bool[Tensor, "n"]:
    """Which Gaussians are guesses and hide the others from cameras between and beside the photos.

    A guess has its centre outside all photos, or more than `PrunePolicy.one_photo` of its blending weight in one of
    them. It stands in front: it keeps more than `PrunePolicy.in_front` of the weight that it has without the others.
    And it hides them: more than `PrunePolicy.hidden_share` of that weight falls on what they cover without it, farther
    away by more than `PrunePolicy.hidden_depth`.
    With `harm`, the picture of some camera beside has more than so many times the weight of it that the photo has
    which shows it most. `cameras` are those of the photos, and `sizes` these pictures' (`Cameras.of_pictures`); one
    photo has no neighbour.
    """
    shown = torch.zeros_like(gaussians.opacities, dtype=torch.bool)
    largest, total = torch.zeros(2, len(shown)).to(gaussians.opacities)
    for photo in cameras.of_pictures(sizes):
        shown |= photo.sees(gaussians.means, 0)
        weight = blending_weights(gaussians, photo)
        largest, total = torch.maximum(largest, weight), total + weight
    shown &= largest <= PRUNE_POLICY.one_photo * total
    guessed, beside = gaussians[~shown], _beside(cameras)
    weight, most, alone, excess = torch.zeros(4, len(guessed)).to(gaussians.opacities)
    for view in range(len(beside)):
        camera = beside[[view]]
        others = render(gaussians[shown], camera)
        covered, depths = others.alpha[0], others.alpha[0] * others.depth[0]
        pixels = torch.stack([torch.ones_like(covered), covered, depths])
        here, over, depth = three_blending_weights(gaussians, camera, pixels)[:, ~shown]
        nearer = camera.local(guessed.means, 0)[:, 2] * over < (1 - PRUNE_POLICY.hidden_depth) * depth
        weight, most = weight + here, torch.maximum(most, here)
        alone += blending_weights(guessed, camera)
        excess += over * nearer - PRUNE_POLICY.hidden_share * here
    harmful = most / BESIDE_SCALE**2 > harm * largest[~shown]
    found = torch.zeros_like(shown)
    found[~shown] = (weight > PRUNE_POLICY.in_front * alone) & (excess > 0) & harmful
    return found


def _beside(cameras: Cameras) -> Cameras:
    """At most `PrunePolicy.hiding_views` cameras between and beyond each of `cameras` and its nearest others.

    The sides of their pictures are `BESIDE_SCALE` times as long.
    """
    near = nearest_first(cameras.centres)
    pairs = {
        tuple(sorted((one, other)))
        for one, row in enumerate(near.tolist())
        for other in [view for view in row if view != one][: PRUNE_POLICY.hiding_neighbours]
    }
    places = [(pair, share) for pair in sorted(pairs) for share in PRUNE_POLICY.hiding_places]
    some = evenly_spaced(places, PRUNE_POLICY.hiding_views)
    if not some:
        return cameras[[]]
    placed = [on_the_line(cameras[list(pair)].to("cpu"), share) for pair, share in some]
    joined = Cameras.joined(placed).resized(*(int(BESIDE_SCALE * side) for side in (cameras.height, cameras.width)))
    return joined.to(cameras.w2c.device)
