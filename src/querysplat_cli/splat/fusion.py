"""Rendered depth of many views becomes one surface: a truncated signed distance function (TSDF) and its zero crossing.

Curless and Levoy 1996. A voxel holds the mean over the views of how far it lies in front of the surface that the view
shows, cut off at the truncation distance. Only voxels near a rendered surface are filled.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.progress import Progress
from querysplat_cli.scene.cameras import NEAREST_DEPTH, Cameras
from querysplat_cli.scene.formats.mesh import TriangleMesh, mesh_part
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.quantiles import picked
from querysplat_cli.splat.render import render
from querysplat_cli.splat.surface_depth import surface_depth

BLOCK = 8
"""Voxels along the side of a block. Blocks near a surface are filled whole."""
NO_SURFACE = QuerySplatError("the views show no surface that could become a mesh", "Try --points.")


@dataclass(frozen=True)
class FusionPolicy:
    """How fine a mesh is, and which depth takes part. Chosen on fortress.

    least_confidence: pixels whose depth is less sure take no part (`splat/surface_depth.py`).
    far: share of the surface points, the farthest from their cameras, that need not become part of the mesh.
    strays: share of the others beyond either end of each axis that the box of the mesh leaves out.
    voxels: the most voxels of that box.
    truncation: in voxels.
    least_island: connected parts with a smaller share of the triangles are left out.
    """

    least_confidence: float = 0.5
    far: float = 0.03
    strays: float = 0.001
    voxels: int = 320**3
    truncation: float = 4.0
    least_island: float = 0.002


FUSION_POLICY = FusionPolicy()


@dataclass(frozen=True)
class _Shown:
    """What the views show. Depth is camera z; confidence is 0 where the depth takes no part."""

    cameras: Cameras
    depth: Float[Tensor, "views height width"]
    confidence: Float[Tensor, "views height width"]
    colour: UInt8[Tensor, "views height width 3"]


@dataclass(frozen=True)
class _Grid:
    """Voxel (i, j, k) has its centre at `low` + `step` · (i, j, k); there are `shape` of them."""

    low: Float[Tensor, "3"]
    step: float
    shape: tuple[int, int, int]

    def places(self, voxels: Tensor) -> Float[Tensor, "n 3"]:
        """Centres of voxels, or what lies between them, by their indices [n, 3]."""
        return self.low + self.step * voxels


@torch.no_grad()
def fused(
    gaussians: Gaussians,
    cameras: Cameras,
    sizes: Sequence[tuple[int, int]],
    progress: Progress,
    policy: FusionPolicy = FUSION_POLICY,
) -> TriangleMesh:
    """The surface that the Gaussians show to the cameras, in their frame.

    `sizes` are (height, width) of the pictures, each in the top-left corner of the canvas: beyond them, where no photo
    looked, there is no depth. Raises QuerySplatError where the views show none, and MissingPart without scikit-image.
    """
    shown = _rendered(gaussians, cameras, sizes, progress, policy)
    grid, voxels = _near_surfaces(shown, policy)
    progress("joining depth", 0.7)
    distances = _distances(shown, grid, voxels, policy)
    places, triangles = _zero_crossing(grid, voxels, distances)
    places, triangles = _without_islands(places, triangles, policy)
    colours = _colours(shown, torch.from_numpy(places), policy.truncation * grid.step)
    return TriangleMesh(places, colours, triangles)


def _rendered(
    gaussians: Gaussians,
    cameras: Cameras,
    sizes: Sequence[tuple[int, int]],
    progress: Progress,
    policy: FusionPolicy,
) -> _Shown:
    depths, sure, colours = [], [], []
    for view, (height, width) in enumerate(sizes):
        progress(f"depth from camera {view + 1} of {len(cameras)}", 0.7 * view / len(cameras))
        picture = render(gaussians, cameras[[view]])
        surface = surface_depth(gaussians, cameras[[view]], picture)
        depths.append(surface.depth)
        inside = torch.zeros_like(surface.confidence)
        inside[:height, :width] = 1
        sure.append(torch.where(surface.confidence >= policy.least_confidence, inside * surface.confidence, 0.0))
        colour = picture.colour[0] / picture.alpha[0].clamp_min(1e-6)
        colours.append((colour.clamp(0, 1) * 255).round().to(torch.uint8).permute(1, 2, 0))
    return _Shown(cameras, torch.stack(depths), torch.stack(sure), torch.stack(colours))


def _near_surfaces(shown: _Shown, policy: FusionPolicy) -> tuple[_Grid, Int[Tensor, "n 3"]]:
    """A grid around what the views show, and those of its voxels that are near a surface.

    A voxel is as large as a pixel at the median depth, or larger where there would be too many.
    """
    points, depths, footprints = [], [], []
    y, x = (torch.arange(size) + 0.5 for size in shown.depth.shape[1:])
    for view, confidence in enumerate(shown.confidence):
        camera, depth, sure = shown.cameras[[view]], shown.depth[[view]], confidence[None] != 0
        points.append(camera.unproject(depth, x, y)[sure])
        depths.append(depth[sure])
        footprints.append(depth[sure] / camera.K[0, 0, 0])
    cloud, z = torch.cat(points), torch.cat(depths)
    if len(cloud) < BLOCK:
        raise NO_SURFACE
    near_cloud = cloud[z <= picked(z, 1 - policy.far)]
    low, high = picked(near_cloud, policy.strays, 1 - policy.strays)
    size = (high - low).double().clamp_min(1e-6)
    step = max(float(torch.cat(footprints).median()), float(size.prod() / policy.voxels) ** (1 / 3))
    margin = policy.truncation * step
    blocks = [int(side) + 1 for side in (size + 2 * margin) / (BLOCK * step)]
    grid = _Grid(low - margin, step, (BLOCK * blocks[0], BLOCK * blocks[1], BLOCK * blocks[2]))
    found = ((cloud - grid.low) / (BLOCK * step)).floor().long()
    found = found[((found >= 0) & (found < torch.tensor(blocks))).all(1)]
    near = torch.zeros(blocks)
    near[tuple(found.T)] = 1.0
    near = torch.nn.functional.max_pool3d(near[None, None], 3, 1, 1)[0, 0] > 0
    inside = torch.cartesian_prod(*[torch.arange(BLOCK)] * 3)
    return grid, (BLOCK * torch.nonzero(near)[:, None] + inside).reshape(-1, 3)


def _seen(shown: _Shown, view: int, places: Float[Tensor, "n 3"]) -> tuple[Tensor, Tensor, Tensor]:
    """Which places lie in front of a camera inside its picture, and their (row, column) and z; all of those alone."""
    x, y, z = shown.cameras.project(places, view)
    height, width = shown.depth.shape[1:]
    inside = (z > NEAREST_DEPTH) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
    rows = torch.nonzero(inside)[:, 0]
    return rows, torch.stack([y[rows], x[rows]]).long(), z[rows]


def _distances(shown: _Shown, grid: _Grid, voxels: Tensor, policy: FusionPolicy) -> Float[Tensor, "n"]:
    """Mean truncated distance of each voxel, in truncation distances, positive in front; NaN where no view tells."""
    reach = policy.truncation * grid.step
    total, weight = torch.zeros(len(voxels)), torch.zeros(len(voxels))
    places = grid.places(voxels)
    for view in range(len(shown.cameras)):
        rows, pixel, z = _seen(shown, view, places)
        ahead = (shown.depth[view][tuple(pixel)] - z) / reach
        trust = torch.where(ahead > -1, shown.confidence[view][tuple(pixel)], 0.0)
        total.index_add_(0, rows, trust * ahead.clamp_max(1.0))
        weight.index_add_(0, rows, trust)
    return total / weight.where(weight > 0, torch.nan)


def _zero_crossing(grid: _Grid, voxels: Tensor, distances: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Corners [n, 3] in the frame of the cameras, and triangles, by marching cubes over fully measured cells."""
    volume = torch.full(grid.shape, torch.nan)
    volume[tuple(voxels.T)] = distances
    measured = (~volume.isnan()).numpy()
    whole = measured[1:, 1:, 1:].copy()
    for shift in range(7):
        i, j, k = shift >> 2 & 1, shift >> 1 & 1, shift & 1
        x, y, z = grid.shape
        whole &= measured[i : x - 1 + i, j : y - 1 + j, k : z - 1 + k]
    mask = np.zeros(grid.shape, bool)
    mask[1:, 1:, 1:] = whole  # a cell belongs to its last corner
    values = volume.nan_to_num_(1.0).numpy()
    if not whole.any() or values[mask].min() >= 0:
        raise NO_SURFACE
    marching_cubes = mesh_part("skimage.measure").marching_cubes
    places, triangles, *_ = marching_cubes(values, 0.0, mask=mask, allow_degenerate=False)
    return grid.places(torch.from_numpy(places.copy())).numpy(), triangles.astype(np.int64)


def _without_islands(places: np.ndarray, triangles: np.ndarray, policy: FusionPolicy) -> tuple[np.ndarray, np.ndarray]:
    edges = np.concatenate([triangles[:, :2], triangles[:, 1:]])
    links = coo_array((np.ones(len(edges), bool), tuple(edges.T)), shape=(len(places),) * 2)
    island = connected_components(links, directed=False)[1][triangles[:, 0]]
    large = np.bincount(island) >= policy.least_island * len(triangles)
    triangles = triangles[large[island]]
    used, rows = np.unique(triangles, return_inverse=True)
    return places[used], rows.reshape(-1, 3)


def _colours(shown: _Shown, places: Tensor, reach: float) -> UInt8[np.ndarray, "n 3"]:
    """Mean colour of the views that show each place; of all views whose pictures contain it where none does."""
    total, weight = torch.zeros(len(places), 3), torch.zeros(len(places), 1)
    for view in range(len(shown.cameras)):
        rows, pixel, z = _seen(shown, view, places)
        visible = (shown.depth[view][tuple(pixel)] - z).abs() < reach
        trust = torch.where(visible, shown.confidence[view][tuple(pixel)], 0.0)[:, None] + 1e-6
        total.index_add_(0, rows, trust * shown.colour[view][tuple(pixel)].float())
        weight.index_add_(0, rows, trust)
    return (total / weight.clamp_min(1e-12)).round().to(torch.uint8).numpy()
