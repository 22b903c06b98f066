"""Masks that leave less than half of the photos cut things out: beside these the scene is transparent."""

from dataclasses import replace

import pytest
import torch
from tto_scenes import photo_of_wall, wall

from querysplat_cli.scene.cameras import Cameras, project_points
from querysplat_cli.scene.views import Views
from querysplat_cli.splat.render import render
from querysplat_cli.tto.gaussians import optimise_gaussians
from querysplat_cli.tto.options import TtoSettings
from querysplat_cli.tto.rendering_loss import RenderingLoss

SIDE = 48


def photo_within(first: int, last: int) -> tuple[Views, Cameras]:
    """A photo of a wall whose mask shows the rows and columns from `first` to before `last`."""
    views, cameras = photo_of_wall(SIDE)
    masks = torch.zeros_like(views.masks)
    masks[:, first:last, first:last] = True
    return replace(views, images=views.images * masks[:, None], masks=masks), cameras


@pytest.mark.parametrize(("first", "last", "cut_out"), [(12, 36, True), (4, 44, False)])
def test_the_scene_becomes_transparent_beside_a_cut_out(first: int, last: int, cut_out: bool) -> None:
    views, cameras = photo_within(first, last)
    target = RenderingLoss.for_solid_scenes(views, cameras, torch.Generator().manual_seed(0))
    assert target.cut_out == cut_out
    start = wall(16, size=1.2, opacity=0.5)
    found = optimise_gaussians(start, target, TtoSettings(60, 0.02), generator=torch.Generator().manual_seed(0))
    alpha = render(found.gaussians, cameras).alpha[0]
    inside, outside = alpha[first + 2 : last - 2, first + 2 : last - 2], alpha[views.masks[0].logical_not()]
    assert float(inside.mean()) > 0.9
    assert (float(outside.mean()) < 0.2) == cut_out


def test_pixels_at_the_edge_of_a_cut_out_and_padding_may_be_covered() -> None:
    """The thing covers a part of those, and padding is no part of the photo."""
    views, cameras = photo_within(12, 36)
    views, points = replace(views, sizes=((40, SIDE),)), wall(24, size=0.1, opacity=0.5)
    slopes = []
    for cut_out in (False, True):
        target = replace(
            RenderingLoss.for_solid_scenes(views, cameras, torch.Generator().manual_seed(0)), cut_out=cut_out
        )
        slopes.append(target.value_and_gradient(points, [0]).gradient.opacities)
    pushed = slopes[1] - slopes[0]
    pushed /= pushed.max()
    column, row = project_points(points.means, cameras.w2c[0], cameras.K[0]).T
    beside = (torch.maximum((row - 24).abs(), (column - 24).abs()) > 15) & (row < 38)
    assert float(pushed[beside & (row > 2) & (column > 2) & (column < SIDE - 2)].min()) > 0.5
    assert float(pushed[(row > 42) | (torch.maximum((row - 24).abs(), (column - 24).abs()) < 11)].max()) < 1e-3
