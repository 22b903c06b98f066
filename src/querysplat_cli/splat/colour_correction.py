"""Renders in the colours of a photo: what a score must do before it can compare photos of other exposures."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

RIDGE = 1e-6
"""Mean squared pull of the transform towards the identity, so that pictures of one colour have one, too."""


def colour_corrected(
    picture: Float[Tensor, "3 height width"],
    photo: Float[Tensor, "3 height width"],
    mask: Bool[Tensor, "height width"],
) -> Float[Tensor, "3 height width"]:
    """`picture` after the affine colour transform of least squares to the pixels of `photo` in `mask`, clipped."""
    known = torch.cat([picture[:, mask], picture.new_ones(1, int(mask.sum()))]).double()
    square = torch.eye(4, dtype=known.dtype, device=known.device) * RIDGE * max(known.shape[1], 1)
    right = known @ photo[:, mask].mT.double() + square[:, :3]
    matrix = torch.linalg.solve(known @ known.mT + square, right).mT.to(picture)
    return (torch.einsum("ij,jhw->ihw", matrix[:, :3], picture) + matrix[:, 3, None, None]).clamp(0, 1)


def left_half(mask: Bool[Tensor, "height width"]) -> Bool[Tensor, "height width"]:
    """The pixels of `mask` in the left half of the picture."""
    half = mask.clone()
    half[:, mask.shape[1] // 2 :] = False
    return half
