"""The CPU splatter: compiled projection, dealing and blending behind one differentiable function."""

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.splat.compiled_blending import BLENDED_PLANES, blend_backward
from querysplat_cli.splat.compiled_blending import blend as blend_tiles
from querysplat_cli.splat.compiled_projection import (
    GAUSSIANS_AT_ONCE,
    GRADIENT_COLUMNS,
    ROW_COLUMNS,
    VIEW_COLUMNS,
    by_depth,
    project_view,
)
from querysplat_cli.splat.compiled_projection_backward import project_view_backward
from querysplat_cli.splat.compiled_tiles import HIGH, WIDE, deal, find_spans, tile_rows
from querysplat_cli.splat.conventions import RenderSettings

PAIRS_LIMIT = 2**28
"""Most (tile, Gaussian) pairs of one view: 1 GiB of lists."""
LOWEST_ALPHA_MIN = 0.0025
"""e⁻⁶, rounded up: the kernel's exponential is accurate down to there."""


def blend(
    gaussians: Gaussians, cameras: Cameras, settings: RenderSettings
) -> tuple[
    Float[Tensor, "views 3 height width"], Float[Tensor, "views height width"], Float[Tensor, "views height width"]
]:
    """Colour on black, alpha, and Σ w·z of every view, in float32.

    Raises QuerySplatError when the Gaussians of one view would fill more than 1 GiB of tile lists, and when
    `settings.alpha_min` is below 0.0025, where the kernel's exponential ends.
    """
    if settings.alpha_min < LOWEST_ALPHA_MIN:
        raise QuerySplatError(
            f"the CPU splatter cannot follow alpha down to {settings.alpha_min:.2g}",
            f'Take alpha_min ≥ {LOWEST_ALPHA_MIN}, or backend="reference".',
        )
    fields = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh)
    colour, alpha, depth = _Blend.apply(
        *(field.float().contiguous() for field in fields),
        cameras.w2c,
        cameras.K,
        cameras.height,
        cameras.width,
        settings,
    )
    return colour, alpha, depth


@dataclass(frozen=True)
class _View:
    """What the backward pass of one view needs from the forward pass."""

    camera: np.ndarray
    rows: np.ndarray
    starts: np.ndarray
    lists: np.ndarray


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        opacities: Tensor,
        sh: Tensor,
        w2c: Tensor,
        K: Tensor,
        height: int,
        width: int,
        settings: RenderSettings,
    ) -> tuple[Tensor, Tensor, Tensor]:
        arrays = [tensor.detach().numpy() for tensor in (means, quats, scales, opacities, sh)]
        planes = np.empty((len(w2c), BLENDED_PLANES, height, width), np.float32)
        rows = _camera_rows(Cameras(w2c.detach().double(), K.detach().double(), height, width))
        views = [_forward_view(arrays, camera, settings, planes[v]) for v, camera in enumerate(rows)]
        result = torch.from_numpy(planes)
        ctx.save_for_backward(means, quats, scales, opacities, sh, w2c)
        ctx.views, ctx.settings, ctx.planes = views, settings, planes
        ctx.set_materialize_grads(False)
        return result[:, :3], result[:, 3], result[:, 4]

    @staticmethod
    def backward(
        ctx: Any, of_colour: Tensor | None, of_alpha: Tensor | None, of_depth: Tensor | None
    ) -> tuple[Tensor | None, ...]:
        *tensors, w2c = ctx.saved_tensors
        arrays = [tensor.detach().numpy() for tensor in tensors]
        gradients = [np.zeros_like(array) for array in arrays]
        tasks = numba.get_num_threads()
        parts = np.empty((tasks, len(arrays[0]), GRADIENT_COLUMNS), np.float32)
        of_views = np.zeros((len(ctx.views), -(-len(arrays[0]) // GAUSSIANS_AT_ONCE), VIEW_COLUMNS))
        planes = ctx.planes
        slopes = np.zeros_like(planes)
        for part, given in ((slopes[:, :3], of_colour), (slopes[:, 3], of_alpha), (slopes[:, 4], of_depth)):
            if given is not None:
                part[:] = given.numpy()
        tiles_x = -(-planes.shape[3] // WIDE)
        for v, view in enumerate(ctx.views):
            parts[:] = 0
            blend_backward(
                view.rows,
                view.starts,
                view.lists,
                _fair_shares(view.starts, tasks),
                tiles_x,
                _blend_limits(ctx.settings),
                planes[v],
                slopes[v],
                parts,
            )
            limits = _projection_limits(ctx.settings)
            project_view_backward(*arrays, view.camera, limits, view.rows, parts, *gradients, of_views[v])
        of_cameras = _camera_gradients(w2c, torch.from_numpy(of_views).sum(1))
        return (*(torch.from_numpy(gradient) for gradient in gradients), *of_cameras, None, None, None)


def _forward_view(arrays: list[np.ndarray], camera: np.ndarray, settings: RenderSettings, planes: np.ndarray) -> _View:
    height, width = planes.shape[1:]
    tiles_x, tiles_y = -(-width // WIDE), -(-height // HIGH)
    rows = np.empty((len(arrays[0]), ROW_COLUMNS), np.float32)
    depths = np.empty(len(arrays[0]), np.float32)
    project_view(*arrays, camera, _projection_limits(settings), rows, depths)
    order = by_depth(depths.view(np.uint32))
    tasks = 2 * numba.get_num_threads()
    first, spans_of = (np.empty(len(rows), np.int32) for _ in range(2))
    tile_rows(rows, tiles_y, first, spans_of)
    offsets = np.concatenate([[0], np.cumsum(spans_of, dtype=np.int64)])
    counts = np.zeros((tasks, tiles_x * tiles_y), np.int64)
    spans = np.empty((offsets[-1], 2), np.int32)
    find_spans(rows, first, offsets, settings.alpha_min, tiles_x, spans, counts)
    starts = np.concatenate([[0], np.cumsum(counts.sum(0))])
    if starts[-1] > PAIRS_LIMIT:
        raise QuerySplatError(
            f"{len(order):,} Gaussians cover {starts[-1]:,} tiles, more than the {PAIRS_LIMIT:,} that fit in memory",
            "Most of them are far too large; prune or shrink them, or render smaller pictures.",
        )
    lists = np.empty(starts[-1], np.int32)
    deal(order, first, offsets, spans, tiles_x, tiles_y, min(tiles_y, tasks), starts, lists)
    blend_tiles(rows, starts, lists, tiles_x, _blend_limits(settings), planes)
    return _View(camera, rows, starts, lists)


def _fair_shares(starts: np.ndarray, tasks: int) -> np.ndarray:
    """Tile numbers that cut the pairs into `tasks` nearly equal runs."""
    cuts = np.searchsorted(starts, np.linspace(0, starts[-1], tasks + 1))
    cuts[0], cuts[-1] = 0, len(starts) - 1
    return cuts.astype(np.int64)


def _camera_rows(cameras: Cameras) -> np.ndarray:
    """[views, 18] float64: rotation, centre, fx, fy, cx, cy, width, height."""
    w2c = cameras.w2c.numpy()
    rotation = w2c[:, :3, :3]
    centres = -np.einsum("vji,vj->vi", rotation, w2c[:, :3, 3])
    intrinsics = torch.stack(cameras.intrinsics, 1).numpy()
    size = np.broadcast_to([float(cameras.width), float(cameras.height)], (len(w2c), 2))
    return np.concatenate([rotation.reshape(-1, 9), centres, intrinsics, size], 1)


def _camera_gradients(w2c: Tensor, of_views: Float[Tensor, "views 16"]) -> tuple[Tensor, Tensor]:
    """The gradients with respect to w2c = [R t] and K, from those of the columns of `d_view`; the centre is −Rᵀt."""
    against_centre = of_views[:, 9:12]
    matrices = torch.zeros(len(w2c), 4, 4, dtype=torch.float64)
    shift = w2c[:, :3, 3].double()
    matrices[:, :3, :3] = of_views[:, :9].reshape(-1, 3, 3) + shift[:, :, None] * against_centre[:, None, :]
    matrices[:, :3, 3] = torch.einsum("vij,vj->vi", w2c[:, :3, :3].double(), against_centre)
    of_K = torch.zeros(len(w2c), 3, 3, dtype=torch.float64)
    of_K[:, [0, 1, 0, 1], [0, 1, 2, 2]] = of_views[:, 12:]
    return matrices, of_K


def _projection_limits(settings: RenderSettings) -> np.ndarray:
    return np.array([settings.near, settings.far, settings.low_pass, settings.alpha_min])


def _blend_limits(settings: RenderSettings) -> np.ndarray:
    return np.array([settings.alpha_max, settings.alpha_min, settings.transmittance_min], np.float32)
