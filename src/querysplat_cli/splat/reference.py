"""The splatter as its equations are written, without tiles: slow, exact, and in any precision."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.splat.conventions import RenderSettings
from querysplat_cli.splat.projection import Projected, project_gaussians

PAIRS_AT_ONCE = 2**22
"""(pixel, Gaussian) pairs that are held in memory together: 32 MiB for each intermediate result."""


def blend(
    gaussians: Gaussians, cameras: Cameras, settings: RenderSettings
) -> tuple[
    Float[Tensor, "views 3 height width"], Float[Tensor, "views height width"], Float[Tensor, "views height width"]
]:
    """Colour on black, alpha, and Σ w·z of every view."""
    cameras = cameras.to(gaussians.means.dtype)
    views = [
        _blend_view(project_gaussians(gaussians, cameras[[view]], settings), cameras.height, cameras.width, settings)
        for view in range(len(cameras))
    ]
    stacked = torch.stack(views) if views else gaussians.means.new_zeros(0, 5, cameras.height, cameras.width)
    return stacked[:, :3], stacked[:, 3], stacked[:, 4]


def _blend_view(seen: Projected, height: int, width: int, settings: RenderSettings) -> Tensor:
    """[5, height, width]: red, green, blue, alpha, Σ w·z."""
    rows = seen.visible.nonzero()[:, 0]
    order = rows[seen.depth[rows].argsort(stable=True)]
    centre, conic, opacity = seen.centre[order], seen.conic[order], seen.opacity[order]
    values = torch.cat([seen.colour[order], torch.ones_like(opacity)[:, None], seen.depth[order][:, None]], 1)
    dtype = centre.dtype
    x = (torch.arange(width, dtype=dtype) + 0.5).repeat(height)
    y = (torch.arange(height, dtype=dtype) + 0.5).repeat_interleave(width)

    def rows_of(x: Tensor, y: Tensor) -> Tensor:
        dx, dy = x[:, None] - centre[:, 0], y[:, None] - centre[:, 1]
        sigma = 0.5 * (conic[:, 0] * dx * dx + conic[:, 2] * dy * dy) + conic[:, 1] * dx * dy
        alpha = (opacity * torch.exp(-sigma.clamp_min(0))).clamp_max(settings.alpha_max)
        alpha = torch.where(alpha < settings.alpha_min, 0.0, alpha)
        left = torch.cumprod(1 - alpha, 1)
        alpha = torch.where(left <= settings.transmittance_min, 0.0, alpha)
        before = torch.cat([torch.ones_like(left[:, :1]), left[:, :-1]], 1)
        return (alpha * before) @ values

    # The backward pass computes each part again, since the pairs of all parts would fill the memory.
    step = max(1, PAIRS_AT_ONCE // max(1, len(order)))
    parts = [
        checkpoint(rows_of, x[start : start + step], y[start : start + step], use_reentrant=False)
        for start in range(0, height * width, step)
    ]
    return torch.cat(parts).T.reshape(5, height, width)
