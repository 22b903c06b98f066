"""PSNR, SSIM and LPIPS of one picture."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from querysplat_cli.evaluation.lpips import Lpips
from querysplat_cli.splat.similarity import psnr, ssim_metric

METRICS = ("psnr", "ssim", "lpips")
EQUAL = 100.0
"""PSNR in dB that stands for equal pictures, and for anything closer than float32 tells."""


@dataclass(frozen=True)
class Scores:
    """PSNR in dB; SSIM as scikit-image has it, with an 11-pixel Gaussian window; LPIPS None without its weights."""

    psnr: float
    ssim: float
    lpips: float | None


def compare(
    picture: Float[Tensor, "3 height width"], truth: Float[Tensor, "3 height width"], lpips: Lpips | None
) -> Scores:
    """Scores of `picture` against `truth`, both in [0, 1]; every pixel counts."""
    with torch.no_grad():
        distance = float(lpips(picture[None], truth[None])) if lpips else None
    return Scores(min(psnr(picture, truth), EQUAL), ssim_metric(picture, truth), distance)
