"""What describes a block to the query embedding: numbers of about size 1 that do not depend on the scene's frame."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from querysplat_cli.queries.cells import CELLS, Cells
from querysplat_cli.queries.coverage import ViewComparison
from querysplat_cli.queries.policy import QUERY_POLICY

FEATURES = 10 + 10 * CELLS**2
"""How many numbers describe a block: ten of the block, then ten of each cell."""


def photo_features(cells: Cells, comparison: ViewComparison) -> Float[Tensor, "views rows columns channels"]:
    """The features of every block of every photo, before anything is rendered."""
    return _features(cells, comparison, _border_distances(cells.depth), _usual_size(cells))


def border_features(border: Cells) -> Float[Tensor, "blocks channels"]:
    """The features of blocks outside all photos.

    No decoder was trained on such blocks, so their features claim that they are inner blocks of the usual size. With
    their true size and place, the decoder made their Gaussians three times as large, and they covered what the photos
    show (held out, 9 dB on fortress).
    """
    nothing = torch.zeros_like(border.depth)
    comparison = ViewComparison(nothing > 0, border.colour, nothing, nothing)
    return _features(border, comparison, nothing.new_ones(len(nothing), 4), _usual_size(border))


def _features(
    cells: Cells, comparison: ViewComparison, border: Float[Tensor, "*blocks 4"], usual: Float[Tensor, ""]
) -> Float[Tensor, "*blocks channels"]:
    """Of the block: mean colour, confidence, size, slant, and its distances from the picture's four borders.

    Of its cells: colour relative to the block's mean, how the colours of other views change it, confidence, depth, how
    many views agree with it and how many it hides.
    """
    mean = comparison.colour.mean(-2, keepdim=True)
    spacing = CELLS * cells.footprint.mean(-1, keepdim=True)
    ray = F.normalize(cells.point - cells.origin, dim=-1)
    slant = (cells.normal * ray).sum(-1).abs().mean(-1, keepdim=True)
    # Relative to the `usual` logarithm, the size depends neither on the pictures' size nor on the scene's unit.
    size = cells.footprint.mean(-1, keepdim=True).log() - usual
    whole = (mean[..., 0, :] - 0.5, cells.confidence.mean(-1, keepdim=True), size, slant, border)
    relative = (cells.depth - cells.depth.median(-1, keepdim=True).values) / spacing
    apart = (
        4 * (comparison.colour - mean).flatten(-2),
        4 * (cells.colour - comparison.colour).flatten(-2),
        cells.confidence,
        relative.clamp(-2, 2),
        (comparison.supporters / 2).clamp_max(2),
        (comparison.hidden / 2).clamp_max(2),
    )
    return torch.cat([*whole, *apart], -1)


def _usual_size(cells: Cells) -> Float[Tensor, ""]:
    return cells.footprint.mean(-1).log().median()


def _border_distances(blocks: Float[Tensor, "views rows columns cells"]) -> Float[Tensor, "views rows columns 4"]:
    """Each block's distance from the top, bottom, left and right border, 1 from `near_border` blocks on."""
    views, rows, columns, _ = blocks.shape
    row, column = torch.arange(rows).float(), torch.arange(columns).float()
    sides = torch.broadcast_tensors(
        row[:, None], rows - 1 - row[:, None], column.expand(rows, columns), columns - 1 - column.expand(rows, columns)
    )
    return (torch.stack(sides, -1) / QUERY_POLICY.near_border).clamp_max(1).expand(views, rows, columns, 4)
