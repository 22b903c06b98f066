"""The CPU splatter: compiled projection, dealing and blending behind one differentiable function."""

import threading
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
from querysplat_cli.splat.compiled_blending import blend as blend_tiles
from querysplat_cli.splat.compiled_blending import blend_backward
from querysplat_cli.splat.compiled_pixels import BLENDED_PLANES
from querysplat_cli.splat.compiled_projection import (
    BLUE,
    DEPTH,
    GAUSSIANS_AT_ONCE,
    GREEN,
    RED,
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
    colour, alpha, depth = _Blend.apply(
        *(field.float().contiguous() for field in gaussians.tensors()),
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
        arrays = tuple(tensor.detach().numpy() for tensor in (means, quats, scales, opacities, sh))
        planes = np.empty((len(w2c), BLENDED_PLANES, height, width), np.float32)
        cameras = Cameras(w2c, K, height, width)
        views = [_dealt(arrays, cameras[[view]], settings) for view in range(len(w2c))]
        for view, picture in zip(views, planes, strict=True):
            _fill_planes(view, settings, picture)
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
        arrays = tuple(tensor.detach().numpy() for tensor in tensors)
        gradients = tuple((np.empty_like if ctx.views else np.zeros_like)(array) for array in arrays)
        parts = _parts(len(arrays[0]))
        of_views = np.zeros((len(ctx.views), *_of_view_shape(len(arrays[0]))))
        slopes = _again("slopes", ctx.planes.size).reshape(ctx.planes.shape)
        for part, given in ((slopes[:, :3], of_colour), (slopes[:, 3], of_alpha), (slopes[:, 4], of_depth)):
            part[:] = 0 if given is None else given.numpy()
        for v, view in enumerate(ctx.views):
            _blend_backward(view, ctx.settings, ctx.planes[v], slopes[v], parts)
            limits = _projection_limits(ctx.settings)
            project_view_backward(arrays, view.camera, limits, view.rows, parts, gradients, of_views[v], v == 0)
        of_cameras = _camera_gradients(w2c, torch.from_numpy(of_views).sum(1))
        return (*(torch.from_numpy(gradient) for gradient in gradients), *of_cameras, None, None, None)


@dataclass(frozen=True)
class Drawn:
    """One view that is drawn, on black: planes of red, green, blue, alpha and Σ w·z, to be pulled back once."""

    planes: Float[Tensor, "5 height width"]
    _arrays: tuple[np.ndarray, ...]
    _view: _View
    _settings: RenderSettings

    @staticmethod
    def of(gaussians: Gaussians, camera: Cameras, settings: RenderSettings) -> "Drawn":
        arrays = _arrays(gaussians)
        planes = np.empty((BLENDED_PLANES, camera.height, camera.width), np.float32)
        view = _dealt(arrays, camera, settings)
        _fill_planes(view, settings, planes)
        return Drawn(torch.from_numpy(planes), arrays, view, settings)

    def pull_back(self, slopes: Float[Tensor, "4 height width"]) -> tuple[Gaussians, Float[Tensor, "n"]]:
        """Gradients by `slopes`, ∂loss/∂ of the first four planes, and blending weights, summed over all pixels.

        Where the depth of every Gaussian is 0, so is its plane. A slope of 1 there changes no other gradient, and that
        of a Gaussian's depth is the sum of its blending weights.
        """
        planes = torch.cat([self.planes[:4], torch.zeros_like(self.planes[4:])]).numpy()
        slopes = torch.cat([slopes, torch.ones_like(slopes[:1])])
        self._view.rows[:, DEPTH] = 0
        count = len(self._arrays[0])
        parts = _parts(count)
        _blend_backward(self._view, self._settings, planes, slopes.numpy(), parts)
        weights = parts[:, :, DEPTH].sum(0)
        parts[:, :, DEPTH] = 0
        gradients = tuple(np.empty_like(array) for array in self._arrays)
        limits, view = _projection_limits(self._settings), self._view
        of_view = np.zeros(_of_view_shape(count))
        project_view_backward(self._arrays, view.camera, limits, view.rows, parts, gradients, of_view, True)
        return Gaussians(*map(torch.from_numpy, gradients)), torch.from_numpy(weights)


def weigh(
    gaussians: Gaussians, camera: Cameras, pixel_weights: Float[Tensor, "3 height width"], settings: RenderSettings
) -> Float[Tensor, "3 n"]:
    """The blending weight of each Gaussian in one view times each of the pixel weights, summed over all pixels.

    Each is the gradient of a colour of the Gaussian, for which nothing needs to be blended.
    """
    view = _dealt(_arrays(gaussians), camera, settings)
    slopes = torch.cat([pixel_weights, torch.zeros_like(pixel_weights[:2])]).float().numpy()
    parts = _parts(len(gaussians))
    _blend_backward(view, settings, np.zeros_like(slopes), slopes, parts)
    return torch.from_numpy(parts.sum(0)[:, [RED, GREEN, BLUE]].T)


def _arrays(gaussians: Gaussians) -> tuple[np.ndarray, ...]:
    return tuple(field.detach().float().contiguous().numpy() for field in gaussians.tensors())


class _Kept(threading.local):
    parts = slopes = np.empty(0, np.float32)


_kept = _Kept()


def _parts(count: int) -> np.ndarray:
    """Room for the gradients of the projected rows, for each thread."""
    threads = numba.get_num_threads()
    return _again("parts", threads * count * ROW_COLUMNS).reshape(threads, count, ROW_COLUMNS)


def _again(name: str, count: int) -> np.ndarray:
    """`count` float32 that are the caller's until the name is asked for again: new memory is slow to get."""
    if len(getattr(_kept, name)) < count:
        setattr(_kept, name, _on_lines(count))
    kept: np.ndarray = getattr(_kept, name)
    return kept[:count]


def _on_lines(count: int) -> np.ndarray:
    """`count` float32, the first at the beginning of a line of the cache, of 64 bytes."""
    space = np.empty(count + ROW_COLUMNS, np.float32)
    first = -space.ctypes.data % 64 // space.itemsize
    return space[first : first + count]


def _of_view_shape(count: int) -> tuple[int, int]:
    return -(-count // GAUSSIANS_AT_ONCE), VIEW_COLUMNS


def _blend_backward(
    view: _View, settings: RenderSettings, planes: np.ndarray, slopes: np.ndarray, parts: np.ndarray
) -> None:
    """Overwrite `parts` by the gradients of the projected rows."""
    shares, tiles_x = _fair_shares(view.starts, len(parts)), -(-planes.shape[2] // WIDE)
    limits = _blend_limits(settings)
    blend_backward(view.rows, view.starts, view.lists, shares, tiles_x, limits, planes, slopes, parts)


def _dealt(arrays: tuple[np.ndarray, ...], camera: Cameras, settings: RenderSettings) -> _View:
    """The Gaussians projected into the picture of one camera, and listed for each of its tiles."""
    if settings.alpha_min < LOWEST_ALPHA_MIN:
        raise QuerySplatError(
            f"the CPU splatter cannot follow alpha down to {settings.alpha_min:.2g}",
            f'Take alpha_min ≥ {LOWEST_ALPHA_MIN}, or backend="reference".',
        )
    row, tiles_x, tiles_y = _camera_row(camera), -(-camera.width // WIDE), -(-camera.height // HIGH)
    rows = _on_lines(len(arrays[0]) * ROW_COLUMNS).reshape(-1, ROW_COLUMNS)
    depths = np.empty(len(arrays[0]), np.float32)
    project_view(arrays, row, _projection_limits(settings), rows, depths)
    order = by_depth(depths.view(np.uint32))
    tasks = 2 * numba.get_num_threads()
    first, spans_of = (np.empty(len(order), np.int32) for _ in range(2))
    tile_rows(rows, order, tiles_y, first, spans_of)
    offsets = np.concatenate([[0], np.cumsum(spans_of, dtype=np.int64)])
    counts = np.zeros((tasks, tiles_x * tiles_y), np.int64)
    spans = np.empty((offsets[-1], 2), np.int32)
    find_spans(rows, order, first, offsets, settings.alpha_min, tiles_x, spans, counts)
    starts = np.concatenate([[0], np.cumsum(counts.sum(0))])
    if starts[-1] > PAIRS_LIMIT:
        raise QuerySplatError(
            f"{len(order):,} Gaussians cover {starts[-1]:,} tiles, more than the {PAIRS_LIMIT:,} that fit in memory",
            "Most of them are far too large; prune or shrink them, or render smaller pictures.",
        )
    lists = np.empty(starts[-1], np.int32)
    deal(order, first, offsets, spans, tiles_x, tiles_y, min(tiles_y, tasks), starts, lists)
    return _View(row, rows, starts, lists)


def _fill_planes(view: _View, settings: RenderSettings, planes: np.ndarray) -> None:
    tiles_x = -(-planes.shape[2] // WIDE)
    blend_tiles(view.rows, view.starts, view.lists, tiles_x, _blend_limits(settings), planes)


def _fair_shares(starts: np.ndarray, tasks: int) -> np.ndarray:
    """Tile numbers that cut the pairs into `tasks` nearly equal runs."""
    cuts = np.searchsorted(starts, np.linspace(0, starts[-1], tasks + 1))
    cuts[0], cuts[-1] = 0, len(starts) - 1
    return cuts.astype(np.int64)


def _camera_row(camera: Cameras) -> np.ndarray:
    """[18] float64: rotation, centre, fx, fy, cx, cy, width, height."""
    w2c = camera.w2c[0].detach().double().numpy()
    centre = -np.einsum("ji,j->i", w2c[:3, :3], w2c[:3, 3])
    intrinsics = torch.cat(camera.intrinsics).detach().double().numpy()
    return np.concatenate([w2c[:3, :3].ravel(), centre, intrinsics, [camera.width, camera.height]])


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
