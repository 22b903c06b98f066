"""The backdrop: far Gaussians behind everything, in blurred colours of the photos.

Photos end, and what lies behind the things that they show is seen by none of them. A camera between the photos or
beside them would look through such places at the viewer's own background. There the backdrop continues the photos'
colours, without any shape of its own. It covers the directions of the photos and a margin around them, so a scene of
photos from one side is open at the other.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from querysplat_cli.queries.policy import QUERY_POLICY
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import SH_0, Gaussians
from querysplat_cli.scene.views import Views
from querysplat_cli.splat.render import render

BEHIND = 1e9
"""Distance from a picture, in shares of its size, of a direction behind its camera."""


@torch.no_grad()
def backdrop(gaussians: Gaussians, views: Views, cameras: Cameras) -> Gaussians:
    """Discs on a sphere around the input cameras, which face its centre. It surrounds all but the farthest Gaussians.

    The colour in a direction is the mean of the blurred photos there, or at the nearest border where they end. Far
    parts of a photo count more than near ones.
    """
    policy = QUERY_POLICY
    centre = cameras.centres.mean(0)
    radius = _radius(gaussians, cameras, centre)
    directions = _evenly_spread(policy.backdrop_directions).to(centre)
    points = centre + radius * directions
    total, weights = torch.zeros_like(points), torch.zeros_like(points[:, :1])
    nearest = torch.full_like(points[:, 0], BEHIND)
    for view in range(len(views)):
        place, outside = _places(points, view, views.sizes[view], cameras)
        blurred = _blurred(gaussians, view, views, cameras)
        colour = F.grid_sample(blurred, place[None, None], padding_mode="border", align_corners=False)[0, :, 0].T
        # A photo that ends farther away counts only where no other is nearer.
        weight = ((-(outside / policy.backdrop_fade).square()).exp() + 1e-6) * (outside < BEHIND)
        total += weight[:, None] * colour
        weights += weight[:, None]
        nearest = torch.minimum(nearest, outside)
    kept = nearest < policy.backdrop_margin
    count = int(kept.sum())
    size = radius * math.sqrt(4 * math.pi / policy.backdrop_directions)
    sh = torch.zeros(count, *gaussians.sh.shape[1:]).to(gaussians.sh)
    sh[:, 0] = ((total / weights.clamp_min(1e-12))[kept] - 0.5) / SH_0
    return Gaussians(
        means=points[kept],
        quats=_facing(directions[kept]),
        scales=size * torch.tensor([1.0, 1.0, 0.1]).to(points).repeat(count, 1),
        opacities=torch.full((count,), policy.backdrop_opacity).to(points),
        sh=sh,
    )


def shows_background(views: Views) -> bool:
    """Whether the photos show what is around the things in them. Masks that leave little cut these out."""
    pixels = sum(height * width for height, width in views.sizes)
    return float(views.masks.sum()) >= QUERY_POLICY.backdrop_least_shown * pixels


def _radius(gaussians: Gaussians, cameras: Cameras, centre: Float[Tensor, "3"]) -> float:
    """Of the sphere, in scene units: far enough that a camera among the inputs sees it without parallax."""
    distance = (gaussians.means - centre).norm(dim=1).sort().values
    most, nearly_all = (float(distance[int(share * (len(distance) - 1))]) for share in (0.99, 0.999))
    extent = float((cameras.centres - centre).norm(dim=1).max())
    by_scene, by_cameras = QUERY_POLICY.backdrop_distance
    wanted = max(by_scene * most, by_cameras * extent)
    return max(1.05 * nearly_all, min(QUERY_POLICY.backdrop_farthest, wanted))


def _evenly_spread(count: int) -> Float[Tensor, "count 3"]:
    """Unit vectors on a Fibonacci lattice."""
    number = torch.arange(count) + 0.5
    z = 1 - 2 * number / count
    turn = number * math.pi * (3 - math.sqrt(5))
    level = (1 - z * z).sqrt()
    return torch.stack([level * turn.cos(), level * turn.sin(), z], 1)


def _facing(directions: Float[Tensor, "n 3"]) -> Float[Tensor, "n 4"]:
    """Rotations that take z to the unit vectors `directions`, by the shortest way; from z to −z it is about x."""
    x, y, z = directions.unbind(1)
    quats = torch.stack([1 + z, -y, x, torch.zeros_like(z)], 1)
    opposite = quats.norm(dim=1, keepdim=True) < 1e-3
    return F.normalize(torch.where(opposite, torch.tensor([0.0, 1.0, 0.0, 0.0]).to(quats), quats), dim=1)


def _places(
    points: Float[Tensor, "n 3"], view: int, size: tuple[int, int], cameras: Cameras
) -> tuple[Float[Tensor, "n 2"], Float[Tensor, "n"]]:
    """Where points fall on a photo, from −1 to 1 and clamped to its border; how far outside, in longer sides."""
    height, width = size
    fx, fy, cx, cy = (part[view] for part in cameras.intrinsics)
    x, y, z = cameras.local(points, view).unbind(1)
    in_front = z > 1e-6
    ahead = torch.where(in_front, z, 1.0)
    column, row = fx * x / ahead + cx, fy * y / ahead + cy
    outside = torch.stack([-column, column - width, -row, row - height], 1).amax(1).clamp_min(0) / max(size)
    place = torch.stack([2 * column / width - 1, 2 * row / height - 1], 1).clamp(-1, 1)
    return place, torch.where(in_front, outside, BEHIND)


def _blurred(gaussians: Gaussians, view: int, views: Views, cameras: Cameras) -> Float[Tensor, "1 3 rows columns"]:
    """A photo in a few cells, each the mean of its pixels, in which the fourth power of the depth is the weight."""
    height, width = views.sizes[view]
    photo, mask = views.picture(view)[:, :height, :width], views.masks[view, :height, :width]
    depth = render(gaussians, cameras[[view]]).depth[0, :height, :width]
    relative = depth / depth.median().clamp_min(1e-6)
    weight = relative.clamp(*QUERY_POLICY.backdrop_depths) ** 4 * mask
    side = max(1, min(height, width) // QUERY_POLICY.backdrop_cells)
    # The mean of the whole photo stands in where a cell shows nothing.
    little = 1e-6
    mean = (photo * weight).sum((1, 2)) / weight.sum().clamp_min(1e-12)
    cells = F.avg_pool2d(photo * weight, side) + little * mean[:, None, None]
    return (cells / (F.avg_pool2d(weight[None], side) + little))[None]
