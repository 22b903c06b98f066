"""Renders in the colours of a photo: what a score must do before it can compare photos of other exposures."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

LEAST_VARIANCE = 1e-8
"""Of a photo's channel, which is taken to be of one colour below. Also the least size of a slope."""
RIDGE = 1e-6
"""Mean squared pull of the 3 × 4 transform towards the identity, so that pictures of one colour have one, too."""


def channel_corrected(
    picture: Float[Tensor, "3 height width"],
    photo: Float[Tensor, "3 height width"],
    mask: Bool[Tensor, "height width"],
) -> Float[Tensor, "3 height width"]:
    """`picture` in the colours of `photo`, clipped, as `color_correct_affine` of gsplat's trainer has it.

    In each channel by itself, a·photo + b ≈ picture is fitted by least squares over the pixels of `mask`, so that
    a = cov(photo, picture) / var(photo). The result is (picture − b) / a. A channel without a slope, because the photo
    or the picture has one value there, is shifted to the photo's mean, where gsplat's is black.
    """
    count = mask.sum().clamp(min=1)
    known, wanted = picture[:, mask].double(), photo[:, mask].double()
    known_mean, wanted_mean = known.sum(1) / count, wanted.sum(1) / count
    centred = wanted - wanted_mean[:, None]
    variance = (centred * centred).sum(1) / count
    slope = (centred * (known - known_mean[:, None])).sum(1) / count / variance.clamp(min=LEAST_VARIANCE)
    slope = torch.where(slope.abs() < LEAST_VARIANCE, torch.ones_like(slope), slope)
    offset = known_mean - slope * wanted_mean
    return ((picture.double() - offset[:, None, None]) / slope[:, None, None]).clamp(0, 1).to(picture)


def matrix_corrected(
    picture: Float[Tensor, "3 height width"],
    photo: Float[Tensor, "3 height width"],
    mask: Bool[Tensor, "height width"],
) -> Float[Tensor, "3 height width"]:
    """`picture` after the 3 × 4 transform of least squares to the pixels of `photo` in `mask`, clipped.

    Inria's exposures are such transforms.
    """
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
