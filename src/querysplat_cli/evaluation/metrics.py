"""PSNR, SSIM and LPIPS of one picture, and PSNR and SSIM without its exposure."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from querysplat_cli.evaluation.lpips import Lpips
from querysplat_cli.evaluation.policy import EVALUATION_POLICY
from querysplat_cli.splat.colour_correction import colour_corrected
from querysplat_cli.splat.similarity import psnr, ssim_metric

METRICS = ("psnr", "ssim", "lpips")
CORRECTED = ("psnr_cc", "ssim_cc")
"""Of the picture after the affine colour transform that fits the photo best. They stand beside the others."""


@dataclass(frozen=True)
class Scores:
    """PSNR in dB; SSIM as in scikit-image, with an 11-pixel Gaussian window; LPIPS is None without its weights.

    `psnr_cc` and `ssim_cc` are of the colour-corrected picture; None where they were not measured.
    """

    psnr: float
    ssim: float
    lpips: float | None
    psnr_cc: float | None = None
    ssim_cc: float | None = None


def compare(
    picture: Float[Tensor, "3 height width"], truth: Float[Tensor, "3 height width"], lpips: Lpips | None
) -> Scores:
    """Scores of `picture` against `truth`, both in [0, 1]; every pixel counts."""
    with torch.no_grad():
        distance = float(lpips(picture[None], truth[None])) if lpips else None
        corrected = colour_corrected(picture, truth, torch.ones(truth.shape[1:], dtype=torch.bool))
    plain, without_exposure = (min(psnr(one, truth), EVALUATION_POLICY.psnr_limit) for one in (picture, corrected))
    return Scores(plain, ssim_metric(picture, truth), distance, without_exposure, ssim_metric(corrected, truth))
