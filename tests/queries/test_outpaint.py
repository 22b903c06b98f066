"""Extended pictures against cells of known colours."""

import torch

from querysplat_cli.queries.outpaint import extend_borders
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.views import Views

HEIGHT, WIDTH, CELL, MARGIN = 24, 32, 4, 8
RING = MARGIN // CELL


def scene() -> tuple[Views, Cameras, torch.Tensor]:
    """One view: every cell of 4 × 4 pixels has its own colour and depth; the mask ends after six columns of cells."""
    cells = torch.arange(HEIGHT // CELL * (WIDTH // CELL)).reshape(HEIGHT // CELL, WIDTH // CELL).float() / 48
    grid = cells.repeat_interleave(CELL, 0).repeat_interleave(CELL, 1)
    masks = torch.ones(1, HEIGHT, WIDTH, dtype=torch.bool)
    masks[:, :, 24:] = False
    K = torch.tensor([[[30.0, 0, 15], [0, 28, 11], [0, 0, 1]]])
    views = Views(grid.expand(1, 3, -1, -1).clone(), masks, ("0.png",), ((HEIGHT, WIDTH),))
    return views, Cameras(torch.eye(4)[None], K, HEIGHT, WIDTH), (1 / (1 + grid))[None]


def test_the_nearest_cell_is_repeated() -> None:
    views, cameras, depth = scene()
    views.images[:, :, :, 24:], depth[:, :, 24:] = float("nan"), 0.0  # outside the mask anything is allowed
    around = extend_borders(views, cameras, depth, cell=CELL, margin=MARGIN)
    row, column = torch.meshgrid(torch.arange(6 + 2 * RING) - RING, torch.arange(8 + 2 * RING) - RING, indexing="ij")
    straight = ((row >= 0) & (row < 6)) | ((column >= 0) & (column < 6))
    nearest = (row.clamp(0, 5) * 8 + column.clamp(0, 5)).float() / 48
    torch.testing.assert_close(around.views.images[0, 0][straight], nearest[straight])
    torch.testing.assert_close(1 / around.depth[0][straight], 1 + nearest[straight])
    off = torch.hypot(*((x - x.clamp(0, 5)).float() for x in (row, column)))
    assert torch.equal(around.views.masks[0], (off > 0) & (off <= RING))


def test_the_camera_looks_the_same_way() -> None:
    views, cameras, depth = scene()
    around = extend_borders(views, cameras, depth, cell=CELL, margin=MARGIN)
    pixel = torch.tensor([14.0, 6.0, 1.0])  # the middle of the cell in row 1, column 3
    cell = torch.tensor([RING + 3.5, RING + 1.5, 1.0])
    torch.testing.assert_close(torch.linalg.solve(around.cameras.K[0], cell), torch.linalg.solve(cameras.K[0], pixel))


def test_what_the_user_masked_is_no_border() -> None:
    views, cameras, depth = scene()
    views.masks[:] = True
    views.masks[0, 8:16, 8:16] = False
    border = extend_borders(views, cameras, depth, cell=CELL, margin=MARGIN).views.masks[0]
    assert border.any()
    assert not border[RING:-RING, RING:-RING].any()


def test_a_view_without_a_pixel_has_no_border() -> None:
    views, cameras, depth = scene()
    views.masks[:] = False
    assert not extend_borders(views, cameras, depth, cell=CELL, margin=MARGIN).views.masks.any()
