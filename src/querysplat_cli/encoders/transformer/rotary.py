"""Rotary position embedding on a grid of patches, in the two variants of the VGMs."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class Rotation:
    """Rotates pairs of channels of each patch's queries and keys by angles that depend on the patch's position.

    The channels of a head form `parts` equal parts. In each part, a channel is paired with the one half a part
    further. `cos` and `sin` have a row for each patch. Tokens that come before the patches are not rotated.
    """

    cos: Float[Tensor, "patches channels"]
    sin: Float[Tensor, "patches channels"]
    parts: int

    def apply(self, x: Float[Tensor, "groups heads tokens channels"]) -> Float[Tensor, "groups heads tokens channels"]:
        """The rotated tokens in the precision of `x`; the rotation is done in that of the angles."""
        before = x.shape[-2] - len(self.cos)
        patches = x[..., before:, :].to(self.cos.dtype)
        first, second = patches.unflatten(-1, (self.parts, 2, -1)).unbind(-2)
        partner = torch.stack([-second, first], -2).flatten(-3)
        turned = patches * self.cos + partner * self.sin
        return torch.cat([x[..., :before, :], turned.to(x.dtype)], -2)


def axial_rotation(periods: Float[Tensor, "quarter"], rows: int, columns: int) -> Rotation:
    """VGGT-Omega's: coordinates in [−1, 1] along the longer side, angles 2π·coordinate / period.

    The angles of the row fill a quarter of the head, those of the column the next quarter, and both are repeated.
    See docs/reference/official-checkpoint.md.
    """
    longer = max(rows, columns)
    row, column = (
        2 * (torch.arange(count, device=periods.device, dtype=periods.dtype) + 0.5) / longer - 1
        for count in (rows, columns)
    )
    places = torch.stack(torch.meshgrid(row, column, indexing="ij"), -1).flatten(0, 1)
    angles = (2 * math.pi * places[:, :, None] / periods).flatten(1).repeat(1, 2)
    return Rotation(angles.cos(), angles.sin(), parts=1)


def split_rotation(channels: int, rows: int, columns: int, like: Tensor) -> Rotation:
    """VGGT's: half of the head rotates with the row, half with the column, both counted from 1.

    Angles are position·100^(−2j/h) in a half of h channels. The other tokens have position 0, so they are not
    rotated. `like` gives device and dtype. See docs/reference/official-checkpoint.md.
    """
    half = channels // 2
    frequencies = 100.0 ** (-torch.arange(0, half, 2, device=like.device, dtype=like.dtype) / half)
    row, column = (torch.arange(1, count + 1, device=like.device, dtype=like.dtype) for count in (rows, columns))
    places = torch.stack(torch.meshgrid(row, column, indexing="ij"), -1).flatten(0, 1)
    angles = (places[:, :, None] * frequencies).repeat(1, 1, 2).flatten(1)
    return Rotation(angles.cos(), angles.sin(), parts=2)
