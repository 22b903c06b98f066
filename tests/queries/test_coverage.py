"""The compiled comparison of cells with other views against its equations, one cell after another."""

import pytest
import torch
from torch.nn import functional as F

from querysplat_cli.queries.cells import Cells, measure_cells
from querysplat_cli.queries.coverage import compare_views, uncovered
from querysplat_cli.queries.policy import QUERY_POLICY
from querysplat_cli.scene.cameras import NEAREST_DEPTH, Cameras
from querysplat_cli.scene.views import Views

HEIGHT, WIDTH, VIEWS, CELL = 24, 36, 5, 2


def scene(seed: int, bumps: float) -> tuple[Views, Cameras, torch.Tensor, torch.Tensor]:
    """Views from about the same place of a bumpy wall; one looks the other way. Masks have holes."""
    generator = torch.Generator().manual_seed(seed)
    w2c = torch.eye(4).repeat(VIEWS, 1, 1)
    w2c[:, :3, 3] = torch.tensor([0.1, 0.1, 0.02]) * torch.randn(VIEWS, 3, generator=generator)
    w2c[-1, 0, 0] = w2c[-1, 2, 2] = -1
    K = torch.tensor([[40.0, 0, WIDTH / 2], [0, 40, HEIGHT / 2], [0, 0, 1]]).repeat(VIEWS, 1, 1)
    images = torch.rand(VIEWS, 3, HEIGHT, WIDTH, generator=generator)
    masks = torch.rand(VIEWS, HEIGHT, WIDTH, generator=generator) > 0.2
    coarse = 2 + bumps * torch.randn(VIEWS, 1, 4, 6, generator=generator)
    depth = F.interpolate(coarse, (HEIGHT, WIDTH), mode="bilinear")[:, 0]
    confidence = torch.rand(VIEWS, HEIGHT, WIDTH, generator=generator)
    names = tuple(f"{i}.png" for i in range(VIEWS))
    views = Views(images, masks, names, ((HEIGHT, WIDTH),) * VIEWS)
    return views, Cameras(w2c, K, HEIGHT, WIDTH), depth, confidence


def projected(cells: Cells, cameras: Cameras, own: int, other: int) -> tuple[torch.Tensor, ...]:
    """Pixels x and y, and camera z, of all cells of a view in another one: [blocks, 9] each."""
    shape = cells.depth[own].shape
    return tuple(part.view(shape) for part in cameras.project(cells.point[own].reshape(-1, 3), other))


@pytest.mark.parametrize("seed", range(4))
def test_cells_are_compared_as_the_equations_say(seed: int) -> None:
    views, cameras, depth, confidence = scene(seed, bumps=0.2)
    cells = measure_cells(views, cameras, depth, confidence, CELL)
    found = compare_views(cells, views, cameras, depth, confidence)
    supporters, hidden = torch.zeros_like(cells.depth), torch.zeros_like(cells.depth)
    colour, weight = cells.colour.clone(), torch.ones_like(cells.depth)
    for own in range(VIEWS):
        for other in set(range(VIEWS)) - {own}:
            x, y, z = projected(cells, cameras, own, other)
            column, row = x.long().clamp(0, WIDTH - 1), y.long().clamp(0, HEIGHT - 1)
            seen = (z > NEAREST_DEPTH) & (x >= 0) & (x < WIDTH) & (y >= 0) & (y < HEIGHT)
            seen &= views.masks[other, row, column]
            surface, sure = depth[other, row, column], confidence[other, row, column]
            share = sure * (seen & ((z / surface - 1).abs() < QUERY_POLICY.depth_agreement))
            nearer = z < (1 - QUERY_POLICY.free_space) * surface
            supporters[own] += share
            hidden[own] += seen & nearer & (sure > QUERY_POLICY.confident)
            colour[own] += share[..., None] * views.images[other].movedim(0, 2)[row, column]
            weight[own] += share
    assert supporters.sum() > 100
    assert hidden.sum() > 10
    torch.testing.assert_close(found.supporters, supporters)
    torch.testing.assert_close(found.hidden, hidden)
    torch.testing.assert_close(found.colour, colour / weight[..., None])
    assert torch.equal(found.hiding, found.hidden > found.supporters + cells.confidence)


@pytest.mark.parametrize("seed", range(4))
def test_blocks_are_covered_as_the_equations_say(seed: int) -> None:
    views, cameras, depth, confidence = scene(seed, bumps=0.01)
    cells = measure_cells(views, cameras, depth, confidence, CELL)
    wanted = cells.valid.float().mean(-1) > 0.5
    keep = torch.zeros_like(wanted)
    for own in range(VIEWS):
        covered = torch.zeros(HEIGHT // CELL + 2, WIDTH // CELL + 2)
        for other in range(own):
            x, y, z = projected(cells, cameras, other, own)
            for block in keep[other].nonzero().tolist():
                for part in range(9):
                    at = (*block, part)
                    row, column = int(y[at] // CELL), int(x[at] // CELL)
                    if z[at] > NEAREST_DEPTH and 0 <= row < HEIGHT // CELL and 0 <= column < WIDTH // CELL:
                        mine = own, row // 3, column // 3, row % 3 * 3 + column % 3
                        same = abs(z[at] / cells.depth[mine] - 1) < QUERY_POLICY.depth_agreement
                        if same and cells.footprint[other][at] < QUERY_POLICY.coarser * cells.footprint[mine]:
                            covered[row : row + 3, column : column + 3] = 1  # the cell and its neighbours
        share = F.avg_pool2d(covered[None, 1:-1, 1:-1], 3)[0]
        keep[own] = wanted[own] & (share < QUERY_POLICY.covered)
    assert 0.2 < keep.sum() / wanted.sum() < 0.9
    assert torch.equal(uncovered(cells, wanted, cameras, CELL), keep)
