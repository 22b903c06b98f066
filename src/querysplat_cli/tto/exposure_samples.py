"""Colours of the same surface point in several photos, found through depth."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from querysplat_cli.encoders.base import Geometry
from querysplat_cli.queries.policy import QUERY_POLICY
from querysplat_cli.scene.cameras import Cameras, nearest_first
from querysplat_cli.scene.find_pixels import find_pixels
from querysplat_cli.scene.views import Views
from querysplat_cli.tto.exposure_policy import EXPOSURE_POLICY

SMOOTHING = 5
"""Colours are means over so many pixels in each direction, so that depth errors of a pixel change them little."""


@dataclass(frozen=True)
class ColourSamples:
    """Observations: the view `view[i]` shows the scene point `point[i]` in the sRGB colour `colour[i]`."""

    point: Int[Tensor, "n"]
    view: Int[Tensor, "n"]
    colour: Float[Tensor, "n 3"]

    def __len__(self) -> int:
        return len(self.point)

    def chosen(self, rows: Bool[Tensor, "n"]) -> "ColourSamples":
        """The observations of some rows; their points get new numbers."""
        return ColourSamples(self.point[rows].unique(return_inverse=True)[1], self.view[rows], self.colour[rows])


def sample_colours(views: Views, cameras: Cameras, geometry: Geometry) -> ColourSamples:
    """The points on a grid of pixels of each view that at least one other view shows at the same depth.

    Only confident depth counts, and only colours that are not clipped. `geometry` must have depth.
    """
    assert geometry.depth is not None
    assert geometry.confidence is not None
    shown = views.masks[:, None].float()
    smooth = _mean(views.images * shown) / _mean(shown).clamp_min(1e-6)
    brightest = F.max_pool2d(views.images.amax(1), SMOOTHING, 1, SMOOTHING // 2)
    usable = views.masks & (geometry.confidence > QUERY_POLICY.confident) & (brightest < EXPOSURE_POLICY.saturated)
    rows, columns = _grid(views)
    near = nearest_first(cameras.centres).tolist()
    depth = geometry.depth[:, rows[:, None], columns]
    places = cameras.unproject(depth, columns + 0.5, rows + 0.5).flatten(1, 2)
    found: list[tuple[Tensor, Tensor, Tensor]] = []
    for own in range(len(views)):
        here = usable[own][rows[:, None], columns].flatten()
        shared = torch.zeros_like(here)
        numbers = torch.arange(len(here)) + own * len(here)
        others = [view for view in near[own] if view != own]
        for other in others[: EXPOSURE_POLICY.compared_views]:
            inside, row, column, z = find_pixels(places[own], other, views, cameras)
            agree = (z / geometry.depth[other, row, column] - 1).abs() < QUERY_POLICY.depth_agreement
            same = here & inside & agree & usable[other, row, column]
            shared |= same
            found.append((numbers[same], torch.full((int(same.sum()),), other), smooth[other][:, row, column].T[same]))
        colours = smooth[own][:, rows[:, None], columns].flatten(1).T
        found.append((numbers[shared], torch.full((int(shared.sum()),), own), colours[shared]))
    point, view, colour = (torch.cat(parts) for parts in zip(*found, strict=True))
    return ColourSamples(point.unique(return_inverse=True)[1], view, colour.double())


def _mean(maps: Float[Tensor, "views channels height width"]) -> Float[Tensor, "views channels height width"]:
    """Over `SMOOTHING` pixels in each direction, as far as the map reaches."""
    return F.avg_pool2d(maps, SMOOTHING, 1, SMOOTHING // 2, count_include_pad=False)


def _grid(views: Views) -> tuple[Int[Tensor, "rows"], Int[Tensor, "columns"]]:
    """Rows and columns of evenly spaced pixels."""
    height, width = views.masks.shape[1:]
    count = min(EXPOSURE_POLICY.points_per_view, EXPOSURE_POLICY.most_points // len(views))
    stride = max(1, math.ceil(math.sqrt(height * width / max(count, 1))))
    return torch.arange(stride // 2, height, stride), torch.arange(stride // 2, width, stride)
