"""Which region a place belongs to: that of the core photo that shows it largest.

A photo shows a place that lies in its picture, and not behind what its own region has there. The depth of its picture
over the focal length says how large the place is. A place that no photo shows belongs to the nearest camera. So every
place has one region, whichever region a Gaussian there was made by.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from querysplat_cli.pipeline.policy import PIPELINE_POLICY
from querysplat_cli.scene.cameras import Cameras, project_points
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.splat.render import render

COVERED = 0.5
"""A pixel with less coverage shows nothing that could hide a place."""


@dataclass(frozen=True)
class CoreViews:
    """Cameras of the core photos of all regions at the size of their depth maps, and the region of each.

    depth: see `depth_maps`.
    """

    cameras: Cameras
    depth: Float[Tensor, "views height width"]
    region: Int[Tensor, "views"]

    @classmethod
    def of(cls, parts: Sequence[tuple[Cameras, Tensor]]) -> "CoreViews":
        """The core cameras and depth maps of every region, in their order."""
        depth = torch.cat([maps for _, maps in parts])
        region = torch.cat([torch.full((len(cameras),), number) for number, (cameras, _) in enumerate(parts)])
        return cls(Cameras.joined([cameras for cameras, _ in parts]), depth, region)


def small_cameras(cameras: Cameras) -> Cameras:
    """The cameras for pictures of the size of depth maps."""
    factor = min(1.0, PIPELINE_POLICY.owner_size / max(cameras.height, cameras.width))
    return cameras.resized(max(1, round(factor * cameras.height)), max(1, round(factor * cameras.width)))


@torch.no_grad()
def depth_maps(
    gaussians: Gaussians, cameras: Cameras, sizes: Sequence[tuple[int, int]]
) -> Float[Tensor, "views height width"]:
    """Camera z of what each camera sees, at the size of `small_cameras`.

    Infinite where nothing covers the picture, and zero on the canvas beyond it, where a photo shows no place. `sizes`
    are (height, width) of the pictures on the canvas of `cameras`.
    """
    small, found = small_cameras(cameras), []
    factor = small.height / cameras.height, small.width / cameras.width
    for view, size in enumerate(sizes):
        drawn = render(gaussians, small[[view]])
        depth = torch.where(drawn.alpha[0] > COVERED, drawn.depth[0], torch.inf)
        height, width = (round(scale * side) for scale, side in zip(factor, size, strict=True))
        depth[height:] = 0
        depth[:, width:] = 0
        found.append(depth)
    return torch.stack(found)


@torch.no_grad()
def owners(places: Float[Tensor, "n 3"], views: CoreViews) -> Int[Tensor, "n"]:
    """The region of each place."""
    largest, seen_by = torch.full((len(places),), torch.inf), torch.full((len(places),), -1)
    nearest, beside = largest.clone(), seen_by.clone()
    cameras = views.cameras
    for view, centre in enumerate(cameras.centres):
        region = int(views.region[view])
        distance = (places - centre).norm(dim=1)
        closer = distance < nearest
        nearest, beside = torch.where(closer, distance, nearest), torch.where(closer, region, beside)
        rows = cameras.sees(places, view).nonzero()[:, 0]
        z = places[rows] @ cameras.w2c[view, 2, :3] + cameras.w2c[view, 2, 3]
        column, row = project_points(places[rows], cameras.w2c[view], cameras.K[view]).long().T
        extent = z / cameras.K[view, 0, 0]
        shown = (z <= PIPELINE_POLICY.owner_depth * views.depth[view, row, column]) & (extent < largest[rows])
        largest[rows[shown]], seen_by[rows[shown]] = extent[shown], region
    return torch.where(seen_by >= 0, seen_by, beside)
