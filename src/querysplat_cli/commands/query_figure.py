"""The figure of one query, as in the paper: the attention of both branches, and its Gaussians on the photo."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from querysplat_cli.runtime.figures import new_figure, save_figure
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.views import Views
from querysplat_cli.splat.projection import Projected, project_gaussians
from querysplat_cli.splat.render import RenderSettings

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.patches import Ellipse

SHOWN_VIEWS = 3
"""Photos in the figure: those with the most attention, among them one that shows the query's Gaussians."""
SIGMAS = 2.0
"""Ellipses are drawn at so many standard deviations."""
MARGIN = 4.0
"""Side of the enlarged cutout, in extents of the query's Gaussians."""
LEAST_CUTOUT = 48.0
"""Pixels on a side."""
ROW_INCHES = 3.6


def draw_query(
    path: Path, views: Views, cameras: Cameras, maps: Mapping[str, Float[Tensor, "views rows columns"]], own: Gaussians
) -> None:
    """A row for each photo: the attention of both branches, and the ellipses of the Gaussians `own`.

    Each panel has a cutout around the Gaussians in one corner. The ellipses have the colours and opacities of the
    Gaussians. `maps` are the weights of the patches by the heading of their panels.
    """
    shown = _shown_views(views, cameras, maps, own)
    height, width = views.sizes[shown[0]]
    figure = new_figure(3 * max(2.4, ROW_INCHES * width / height), ROW_INCHES * len(shown))
    grid = figure.subplots(len(shown), 3, squeeze=False)
    for row, view in zip(grid, shown, strict=True):
        height, width = views.sizes[view]
        photo = (views.images[view, :, :height, :width].permute(1, 2, 0).clamp(0, 1) * 255).byte().numpy()
        projected = project_gaussians(own, cameras[[view]], RenderSettings())
        window = _window(projected, height, width)
        for axes, weights in zip(row, maps.values(), strict=False):
            size = views.images.shape[-2:]
            heat = F.interpolate(weights[[view]][:, None], size, mode="bilinear")[0, 0, :height, :width]
            _panel(axes, _attention(photo, heat, float(weights.max())), window, photo)
        row[0].set_ylabel(views.names[view], fontsize=8)
        _panel(row[2], _ellipses(photo, projected), window, photo)
    titles = [*maps, f"its {len(own)} Gaussians, at {SIGMAS:g} standard deviations"]
    for axes, title in zip(grid[0], titles, strict=True):
        axes.set_title(title, fontsize=8)
    save_figure(figure, path)


def _shown_views(views: Views, cameras: Cameras, maps: Mapping[str, Tensor], own: Gaussians) -> list[int]:
    """The photos with the most attention. The first one also shows the most of the query's Gaussians."""
    attention = torch.stack([weights.sum((1, 2)) for weights in maps.values()]).sum(0)
    seen = torch.tensor([float(cameras.sees(own.means, view).float().mean()) for view in range(len(views))])
    first = int((seen + 0.5 * attention / attention.max().clamp_min(1e-12)).argmax())
    rest = [int(view) for view in attention.argsort(descending=True, stable=True) if int(view) != first]
    return [first, *rest][:SHOWN_VIEWS]


def _window(projected: Projected, height: int, width: int) -> tuple[float, float, float] | None:
    """Left, top and side of the cutout in pixels, inside the photo; None where it would be no smaller than that."""
    centres = projected.centre[projected.visible].numpy()
    if not len(centres):
        return None
    side = max(LEAST_CUTOUT, MARGIN * float(np.ptp(centres, 0).max()))
    if side > min(height, width) / 2:
        return None
    left, top = np.clip(np.median(centres, 0) - side / 2, 0, (width - side, height - side)).tolist()
    return left, top, side


def _panel(
    axes: "Axes", draw: Callable[["Axes"], None], window: tuple[float, float, float] | None, photo: np.ndarray
) -> None:
    """What `draw` draws, and its cutout enlarged in the corner that is farthest from it."""
    from matplotlib.patches import Rectangle

    draw(axes)
    axes.set(xticks=[], yticks=[])
    if window is None:
        return
    left, top, side = window
    height, width = photo.shape[:2]
    axes.add_patch(Rectangle((left, top), side, side, fill=False, edgecolor="lime", linewidth=0.8))
    across = 0.01 if left + side / 2 > width / 2 else 0.54
    inset = axes.inset_axes((across, 0.01 if top + side / 2 < height / 2 else 0.54, 0.45, 0.45))
    draw(inset)
    inset.set(xlim=(left, left + side), ylim=(top + side, top), xticks=[], yticks=[])
    for spine in inset.spines.values():
        spine.set_edgecolor("lime")


def _attention(photo: np.ndarray, heat: Tensor, top: float) -> Callable[["Axes"], None]:
    """The photo in grey below the weights, which are opaque where they reach `top`."""
    top = max(top, 1e-12)
    grey = np.repeat(photo.mean(2, keepdims=True).astype(np.uint8), 3, 2)

    def draw(axes: "Axes") -> None:
        axes.imshow(grey)
        axes.imshow(heat.numpy(), cmap="inferno", alpha=(heat / top).sqrt().clamp(0, 1).numpy(), vmin=0, vmax=top)

    return draw


def _ellipses(photo: np.ndarray, projected: Projected) -> Callable[["Axes"], None]:
    def draw(axes: "Axes") -> None:
        axes.imshow(photo)
        for number in projected.visible.nonzero()[:, 0].tolist():
            axes.add_patch(_ellipse(projected, number))

    return draw


def _ellipse(projected: Projected, number: int) -> "Ellipse":
    from matplotlib.patches import Ellipse

    xx, xy, yy = projected.conic[number].tolist()
    spread, axes = np.linalg.eigh(np.linalg.inv(np.array([[xx, xy], [xy, yy]])))
    width, height = 2 * SIGMAS * np.sqrt(spread)
    turned = float(np.degrees(np.arctan2(axes[1, 0], axes[0, 0])))
    colour = projected.colour[number].clamp(0, 1).tolist()
    x, y = projected.centre[number].tolist()
    # Pixel centres are at +0.5 here and at whole numbers in matplotlib's pictures.
    found = Ellipse((x - 0.5, y - 0.5), float(width), float(height), angle=turned, linewidth=0.6)
    found.set_facecolor((*colour, float(projected.opacity[number])))
    found.set_edgecolor("lime")
    return found
