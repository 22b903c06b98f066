"""Regions whose photos have colour transforms get the colours of one scene."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from querysplat_cli.pipeline.regions.groups import Group
from querysplat_cli.pipeline.regions.scene import RegionScene
from querysplat_cli.scene.exposures import Exposures
from querysplat_cli.scene.gaussians import SH_0, Gaussians

Transform = Float[Tensor, "4 4"]


def common_exposures(
    groups: Sequence[Group], scenes: Sequence[RegionScene], views: int
) -> tuple[Exposures | None, list[Transform]]:
    """The transforms of all `views` in the colours of one scene, and those from a region's colours to these.

    A photo of two regions shows both in the same colours, so it says how theirs differ; of several photos this is the
    mean. From region to region, those with the most photos in common are joined first. None where no photo has a
    transform.
    """
    if all(scene.exposures is None for scene in scenes):
        return None, [torch.eye(4).double()] * len(scenes)
    of_photo = [
        dict(zip(group.rows, _matrices(group, scene), strict=True)) for group, scene in zip(groups, scenes, strict=True)
    ]
    to_common: dict[int, Transform] = {0: torch.eye(4).double()}
    while len(to_common) < len(scenes):
        shared = {
            (old, new): sorted(of_photo[old].keys() & of_photo[new].keys())
            for old in to_common
            for new in range(len(scenes))
            if new not in to_common
        }
        old, new = max(shared, key=lambda pair: (len(shared[pair]), -pair[0], -pair[1]))
        between = [torch.linalg.solve(of_photo[old][row], of_photo[new][row]) for row in shared[old, new]]
        step = torch.stack(between).mean(0) if between else torch.eye(4).double()
        to_common[new] = to_common[old] @ step
    found = torch.zeros(views, 3, 4, dtype=torch.float64)
    for number, group in enumerate(groups):
        back = torch.linalg.inv(to_common[number])
        for row in group.core:
            found[row] = (of_photo[number][row] @ back)[:3]
    mean = torch.cat([found.mean(0), torch.eye(4)[3:].double()])
    exposures = Exposures(found).with_identity_mean()
    return exposures, [mean @ to_common[number] for number in range(len(scenes))]


def recoloured(gaussians: Gaussians, transform: Transform) -> Gaussians:
    """`gaussians` whose colour c has become that of the affine `transform`."""
    linear, offset = (part.to(gaussians.sh) for part in (transform[:3, :3], transform[:3, 3]))
    sh = gaussians.sh @ linear.T
    sh[:, 0] += (0.5 * linear.sum(1) + offset - 0.5) / SH_0
    return Gaussians(gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, sh)


def _matrices(group: Group, scene: RegionScene) -> list[Transform]:
    """From the region's colours to those of each of its photos."""
    found = torch.eye(4).double().repeat(len(group.rows), 1, 1)
    if scene.exposures:
        found[:, :3] = scene.exposures.matrices
    return list(found)
