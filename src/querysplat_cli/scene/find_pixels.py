"""Which pixels of a photo world points fall on."""

from jaxtyping import Bool, Float, Int
from torch import Tensor

from querysplat_cli.scene.cameras import NEAREST_DEPTH, Cameras
from querysplat_cli.scene.views import Views


def find_pixels(
    points: Float[Tensor, "n 3"], view: int, views: Views, cameras: Cameras
) -> tuple[Bool[Tensor, "n"], Int[Tensor, "n"], Int[Tensor, "n"], Float[Tensor, "n"]]:
    """Whether points fall on what the photo shows, occluded or not; the row and column of their pixel, and camera z.

    Padding of the canvas and masked pixels show nothing. Where a point falls beside the canvas, row and column are
    those of its nearest pixel. Camera z is at least NEAREST_DEPTH.
    """
    x, y, z = cameras.project(points, view)
    inside = (z > NEAREST_DEPTH) & (x >= 0) & (y >= 0) & (x < cameras.width) & (y < cameras.height)
    column = x.clamp(0, cameras.width - 1).long()
    row = y.clamp(0, cameras.height - 1).long()
    return inside & views.masks[view, row, column], row, column, z.clamp_min(NEAREST_DEPTH)
