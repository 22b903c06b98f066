"""The backdrop: far Gaussians behind everything, in blurred colours of the photos.

Photos end, and what lies behind the things that they show is seen by none of them. A camera between the photos or
beside them would look through such places at the viewer's own background. There the backdrop continues the photos'
colours, on the convex hull of the scene and the cameras. So it stands as near as it can: no camera among the inputs
has it in front of anything, and viewers that frame a scene by its box see the scene and not a large bowl. It covers the
directions of the photos and a margin around them, so a scene of photos from one side is open at the other.
"""

import math

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import ConvexHull
from torch import Tensor
from torch.nn import functional as F

from querysplat_cli.queries.policy import QUERY_POLICY
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.exposures import Exposures
from querysplat_cli.scene.gaussians import SH_0, Gaussians
from querysplat_cli.scene.views import Views
from querysplat_cli.splat.render import render

BEHIND = 1e9
"""Distance from a picture, in shares of its size, of a direction behind its camera."""
THINNEST_HULL = 1e-3
"""Half the thickness of the hull around the cameras' centre, in shares of its size. A flat one has no volume."""
AT_ONCE = 500
"""Directions that are compared with all facets at once. This bounds the memory."""


@torch.no_grad()
def backdrop(gaussians: Gaussians, views: Views, cameras: Cameras, exposures: Exposures | None = None) -> Gaussians:
    """Discs around the scene and its cameras, which face the cameras' centre.

    The colour in a direction is the mean of the blurred photos there, or at the nearest border where they end. Far
    parts of a photo count more than near ones. `exposures` are the colour transforms of the photos, which are removed;
    None where these show the scene's own colours.
    """
    policy = QUERY_POLICY
    centre = cameras.centres.mean(0)
    directions = _evenly_spread(policy.backdrop_directions).to(centre)
    radius = _radii(gaussians, cameras, centre, directions)[:, None]
    points = centre + radius * directions
    total, weights = torch.zeros_like(points), torch.zeros_like(points[:, :1])
    nearest = torch.full_like(points[:, 0], BEHIND)
    for view in range(len(views)):
        place, outside = _places(points, view, views.sizes[view], cameras)
        one = views[[view]]
        one = exposures[[view]].removed_from(one) if exposures else one
        blurred = _blurred(gaussians, one, cameras[[view]])
        colour = F.grid_sample(blurred, place[None, None], padding_mode="border", align_corners=False)[0, :, 0].T
        # A photo that ends farther away counts only where no other is nearer.
        weight = ((-(outside / policy.backdrop_fade).square()).exp() + 1e-6) * (outside < BEHIND)
        total += weight[:, None] * colour
        weights += weight[:, None]
        nearest = torch.minimum(nearest, outside)
    kept = nearest < policy.backdrop_margin
    count = int(kept.sum())
    size = radius[kept] * math.sqrt(4 * math.pi / policy.backdrop_directions)
    sh = torch.zeros(count, *gaussians.sh.shape[1:]).to(gaussians.sh)
    sh[:, 0] = ((total / weights.clamp_min(1e-12))[kept] - 0.5) / SH_0
    return Gaussians(
        means=points[kept],
        quats=_facing(directions[kept]),
        scales=size * torch.tensor([1.0, 1.0, 0.1]).to(points),
        opacities=torch.full((count,), policy.backdrop_opacity).to(points),
        sh=sh,
    )


def shows_background(views: Views) -> bool:
    """Whether the photos show what is around the things in them. Masks that leave little cut these out."""
    pixels = sum(height * width for height, width in views.sizes)
    return float(views.masks.sum()) >= QUERY_POLICY.backdrop_least_shown * pixels


def _radii(
    gaussians: Gaussians, cameras: Cameras, centre: Float[Tensor, "3"], directions: Float[Tensor, "n 3"]
) -> Float[Tensor, "n"]:
    """How far the backdrop is from `centre` in each direction, in scene units."""
    hull = _hull(gaussians, cameras, centre)
    normals, offsets = (torch.from_numpy(part).to(directions.device) for part in np.split(hull.equations, [3], 1))
    found = []
    for some in directions.double().split(AT_ONCE):
        towards = some @ normals.T
        distance = torch.where(towards > 0, -offsets[:, 0] / towards, torch.inf)
        found.append(distance.amin(1))
    extent = (cameras.centres - centre).norm(dim=1).max()
    radii = torch.cat(found).to(directions).clamp_min(QUERY_POLICY.backdrop_nearest * float(extent))
    return QUERY_POLICY.backdrop_behind * _without_steep_sides(radii, directions)


def _without_steep_sides(radii: Float[Tensor, "n"], directions: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """The smallest radii that are no smaller anywhere, and change no faster than a disc can follow."""
    found = []
    for some in directions.split(AT_ONCE):
        angle = (some @ directions.T).clamp(-1, 1).acos()
        found.append((radii * (-QUERY_POLICY.backdrop_steepness * angle).exp()).amax(1))
    return torch.cat(found)


def _hull(gaussians: Gaussians, cameras: Cameras, centre: Float[Tensor, "3"]) -> ConvexHull:
    """Of all Gaussians, with two standard deviations outwards, and of the cameras with some room behind them."""
    gaussians = gaussians[gaussians.finite]
    arms = (gaussians.means - centre).double()
    distance = arms.norm(dim=1, keepdim=True).clamp_min(1e-12)
    ends = arms * (1 + 2 * gaussians.scales.amax(1, keepdim=True).double() / distance)
    behind = QUERY_POLICY.backdrop_behind_cameras * (cameras.centres - centre).double()
    points = torch.cat([ends, behind])
    corners = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0]).double()] * 3).to(points)
    least = THINNEST_HULL * points.abs().amax().clamp_min(1e-6)
    return ConvexHull(torch.cat([points, least * corners]).cpu().numpy())


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


def _blurred(gaussians: Gaussians, view: Views, camera: Cameras) -> Float[Tensor, "1 3 rows columns"]:
    """One photo in a few cells, each the mean of its pixels, in which the fourth power of the depth is the weight."""
    ((height, width),) = view.sizes
    photo, mask = view.picture(0)[:, :height, :width], view.masks[0, :height, :width]
    depth = render(gaussians, camera).depth[0, :height, :width]
    relative = depth / depth.median().clamp_min(1e-6)
    weight = relative.clamp(*QUERY_POLICY.backdrop_depths) ** 4 * mask
    side = max(1, min(height, width) // QUERY_POLICY.backdrop_cells)
    # The mean of the whole photo stands in where a cell shows nothing.
    little = 1e-6
    mean = (photo * weight).sum((1, 2)) / weight.sum().clamp_min(1e-12)
    cells = max(1, round(height / side)), max(1, round(width / side))
    colours = F.adaptive_avg_pool2d(photo * weight, cells) + little * mean[:, None, None]
    return (colours / (F.adaptive_avg_pool2d(weight[None], cells) + little))[None]
