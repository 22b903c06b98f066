"""PSNR, SSIM and LPIPS of one picture."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from querysplat_cli.evaluation.lpips import Lpips
from querysplat_cli.evaluation.policy import EVALUATION_POLICY
from querysplat_cli.splat.similarity import psnr, ssim_metric

METRICS = ("psnr", "ssim", "lpips")


@dataclass(frozen=True)
class Scores:
    """PSNR in dB; SSIM as in scikit-image, with an 11-pixel Gaussian window; LPIPS is None without its weights."""

    psnr: float
    ssim: float
    lpips: float | None


def compare(
    picture: Float[Tensor, "3 height width"], truth: Float[Tensor, "3 height width"], lpips: Lpips | None
) -> Scores:
    """Scores of `picture` against `truth`, both in [0, 1]; every pixel counts."""
    with torch.no_grad():
        distance = float(lpips(picture[None], truth[None])) if lpips else None
    return Scores(min(psnr(picture, truth), EVALUATION_POLICY.psnr_limit), ssim_metric(picture, truth), distance)
