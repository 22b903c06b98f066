"""What a round of refinement reads: the scene beside the photos and the depth maps, from the place of each query.

All numbers are of about size 1 and do not depend on the scene's frame or unit. Lengths are in units of the query's
spacing, directions along the axes of its middle Gaussian.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from querysplat_cli.model.anchors import Anchors
from querysplat_cli.model.refiner import STENCIL, Evidence
from querysplat_cli.queries.policy import QUERY_POLICY
from querysplat_cli.queries.rendering_error import Comparison
from querysplat_cli.scene.cameras import Cameras, distances
from querysplat_cli.scene.gaussians import SH_0, Gaussians
from querysplat_cli.scene.rotations import quaternion_to_matrix
from querysplat_cli.scene.views import Views


@dataclass(frozen=True)
class Surroundings:
    """What stays the same in all rounds: the photos, the VGM's depth, and the nearest other queries of each."""

    views: Views
    cameras: Cameras
    depth: Float[Tensor, "views height width"]
    confidence: Float[Tensor, "views height width"]
    near: Int[Tensor, "queries near"]


def gather_evidence(
    anchors: Anchors,
    gaussians: Gaussians,
    raw: Float[Tensor, "queries raw"],
    comparison: Comparison,
    around: Surroundings,
) -> Evidence:
    """Each query's own numbers, and a row of both memories for each view that may see it.

    `gaussians` are the scene of the round before, `raw` the raw numbers of both heads that it is made of, and
    `comparison` is that scene beside the photos. With more views than the policy's `refining_views`, each query reads
    those that see it from nearest.
    """
    queries, per_query = anchors.opacities.shape
    middle = per_query // 2
    means = gaussians.means.view(queries, per_query, 3)
    centres = means[:, middle]
    axes = quaternion_to_matrix(F.normalize(gaussians.quats.view(queries, per_query, 4)[:, middle], dim=-1))
    places = _Places.of(means, centres, axes, anchors.spacing, around)
    offsets = (centres[around.near] - centres[:, None]) @ axes / anchors.spacing[:, None, None]
    colours = (gaussians.sh[:, 0] * SH_0 + 0.5).view(queries, per_query, 3)
    return Evidence(
        own=torch.cat([anchors.features, comparison.errors.reshape(queries, -1), signed_log(raw)], 1),
        geometry=_geometry_rows(places, colours[:, middle], comparison, around),
        appearance=_appearance_rows(places, colours, comparison, around),
        seen=places.seen,
        views=places.views,
        near=around.near,
        offsets=signed_log(offsets),
    )


def signed_log(values: Tensor) -> Tensor:
    """asinh, which is linear near 0 and logarithmic far from it, clamped to ± 5."""
    return torch.asinh(values).clamp(-5, 5)


@dataclass(frozen=True)
class _Places:
    """Where the queries stand in the scene, and in those views that they read.

    views: their numbers.
    z: the centre's camera z.
    pixels: projections of the centre; `each`: of all Gaussians.
    ray: directions from the camera to the centre, along the query's axes.
    footprint: size of a pixel at the centre, in scene units.
    """

    centres: Float[Tensor, "queries 3"]
    axes: Float[Tensor, "queries 3 3"]
    spacing: Float[Tensor, "queries 1"]
    views: Int[Tensor, "queries rows"]
    z: Float[Tensor, "queries rows"]
    pixels: Float[Tensor, "queries rows 2"]
    each: Float[Tensor, "queries rows gaussians 2"]
    ray: Float[Tensor, "queries rows 3"]
    footprint: Float[Tensor, "queries rows"]
    seen: Bool[Tensor, "queries rows"]

    @staticmethod
    def of(means: Tensor, centres: Tensor, axes: Tensor, spacing: Tensor, around: Surroundings) -> "_Places":
        cameras, pictures = around.cameras, around.cameras.of_pictures(around.views.sizes)
        seen = torch.stack([picture.sees(centres, 0) for picture in pictures], 1)
        views = _read_views(seen, distances(centres, cameras.centres))
        w2c, K = cameras.w2c[views], cameras.K[views]
        local = torch.einsum("qrij,qgj->qrgi", w2c[..., :3, :3], means) + w2c[:, :, None, :3, 3]
        z = local[..., 2].clamp_min(1e-6)
        focal = torch.stack([K[..., 0, 0], K[..., 1, 1]], -1)
        each = local[..., :2] / z[..., None] * focal[:, :, None] + K[:, :, None, :2, 2]
        middle = means.shape[1] // 2
        ray = F.normalize(centres[:, None] - cameras.centres[views], dim=-1)
        return _Places(
            centres=centres,
            axes=axes,
            spacing=spacing[:, None],
            views=views,
            z=z[:, :, middle],
            pixels=each[:, :, middle],
            each=each,
            ray=torch.einsum("qri,qij->qrj", ray, axes),
            footprint=z[:, :, middle] / focal[..., 0],
            seen=seen.gather(1, views),
        )


def _read_views(
    seen: Bool[Tensor, "queries views"], distance: Float[Tensor, "queries views"]
) -> Int[Tensor, "queries rows"]:
    """All views, or, where there are more than a query reads, those that see it from nearest."""
    (queries, count), most = seen.shape, QUERY_POLICY.refining_views
    if count <= most:
        return torch.arange(count, device=seen.device).expand(queries, -1)
    return distance.masked_fill(~seen, torch.inf).topk(most, dim=1, largest=False).indices


def _geometry_rows(
    places: _Places, colour: Float[Tensor, "queries 3"], comparison: Comparison, around: Surroundings
) -> Float[Tensor, "queries rows 36"]:
    """Depth and confidence around the projection; the surface there, its normal, and what the scene renders there."""
    steps = torch.arange(-1.0, 2.0, device=colour.device)
    shift = torch.stack(torch.meshgrid(steps, steps, indexing="xy"), -1).view(STENCIL, 2)
    block = (places.spacing / places.footprint).clamp(1, 30)
    around_it = places.pixels[:, :, None] + block[..., None, None] * shift
    depths = _nearest(around.depth, places.views[..., None], around_it)
    sure = _nearest(around.confidence, places.views[..., None], around_it)
    gaps = signed_log((depths - places.z[..., None]) / places.spacing[..., None])
    here = depths[..., STENCIL // 2]
    surface = _unprojected(places.views, places.pixels, here, around.cameras)
    offset = torch.einsum("qri,qij->qrj", surface - places.centres[:, None], places.axes) / places.spacing[..., None]
    normal = torch.einsum("qri,qij->qrj", _normals(places, around), places.axes)
    rendered = signed_log((_nearest(comparison.depth, places.views, places.pixels) - here) / places.spacing)
    size = (places.footprint / places.spacing).log().clamp(-5, 5)
    numbers = torch.stack([size, rendered, _nearest(comparison.alpha, places.views, places.pixels)], -1)
    photo = _nearest(around.views.images.movedim(1, 3), places.views, places.pixels)
    residual = _nearest(comparison.residual.movedim(1, 3), places.views, places.pixels)
    colours = 4 * residual, photo - colour[:, None]
    return torch.cat([gaps, sure, signed_log(offset), normal, places.ray, numbers, *colours], -1)


def _appearance_rows(
    places: _Places, colours: Float[Tensor, "queries gaussians 3"], comparison: Comparison, around: Surroundings
) -> Float[Tensor, "queries rows channels"]:
    """Photo and residual at the projection of each Gaussian; the viewing ray; whether something stands before it."""
    maps = torch.cat([around.views.images, comparison.residual], 1).movedim(1, 3)
    found = _bilinear(maps, places.views, places.each)
    photo, residual = found[..., :3] - colours[:, None], 4 * found[..., 3:]
    gap = signed_log((_nearest(around.depth, places.views, places.pixels) - places.z) / places.spacing)
    size = (places.footprint / places.spacing).log().clamp(-5, 5)
    numbers = torch.stack([gap, _nearest(around.confidence, places.views, places.pixels), size], -1)
    return torch.cat([photo.flatten(2), residual.flatten(2), places.ray, numbers], -1)


def _nearest(maps: Tensor, views: Int[Tensor, "..."], pixels: Float[Tensor, "*n 2"]) -> Tensor:
    """Maps [views, height, width, …] at the pixels that points fall in, or the nearest of the picture."""
    x, y = (pixels[..., axis].long().clamp(0, maps.shape[2 - axis] - 1) for axis in (0, 1))
    return maps[views, y, x]


def _bilinear(
    maps: Float[Tensor, "views height width channels"],
    views: Int[Tensor, "queries rows"],
    pixels: Float[Tensor, "queries rows gaussians 2"],
) -> Float[Tensor, "queries rows gaussians channels"]:
    """Maps between the centres of the four nearest pixels; beyond the picture, those of its border."""
    places = 2 * pixels / pixels.new_tensor([maps.shape[2], maps.shape[1]]) - 1
    found = pixels.new_empty(*pixels.shape[:3], maps.shape[3])
    for view, each in enumerate(maps.movedim(3, 1)):
        here = views == view
        read = F.grid_sample(each[None], places[here][None], padding_mode="border", align_corners=False)
        found[here] = read[0].movedim(0, 2)
    return found


def _normals(places: _Places, around: Surroundings) -> Float[Tensor, "queries rows 3"]:
    """World normals of the depth maps at the projections, from the differences of the pixels beside."""
    size = places.pixels.new_tensor([around.cameras.width - 1, around.cameras.height - 1])
    pixels = places.pixels.floor().clamp_min(0).minimum(size)

    def surface(x: float, y: float) -> Tensor:
        beside = (pixels + pixels.new_tensor([x, y])).clamp_min(0).minimum(size)
        depth = _nearest(around.depth, places.views, beside)
        return _unprojected(places.views, beside + 0.5, depth, around.cameras)

    across, down = surface(1.0, 0.0) - surface(-1.0, 0.0), surface(0.0, 1.0) - surface(0.0, -1.0)
    return F.normalize(torch.linalg.cross(down, across), dim=-1)


def _unprojected(
    views: Int[Tensor, "queries rows"],
    pixels: Float[Tensor, "queries rows 2"],
    depth: Float[Tensor, "queries rows"],
    cameras: Cameras,
) -> Float[Tensor, "queries rows 3"]:
    """World points of pixels at the given camera z."""
    fx, fy, cx, cy = (part[views] for part in cameras.intrinsics)
    local = torch.stack([(pixels[..., 0] - cx) / fx * depth, (pixels[..., 1] - cy) / fy * depth, depth], -1)
    c2w = cameras.c2w[views]
    return torch.einsum("qrij,qrj->qri", c2w[..., :3, :3], local) + c2w[..., :3, 3]
