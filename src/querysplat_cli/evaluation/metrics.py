"""PSNR, SSIM and LPIPS of one picture, the same without its exposure, and further metrics that are asked for."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields

import torch
from jaxtyping import Float
from torch import Tensor

from querysplat_cli.evaluation.perceptual import further_metric
from querysplat_cli.runtime.choices import FurtherMetric
from querysplat_cli.splat.colour_correction import channel_corrected, left_half, matrix_corrected
from querysplat_cli.splat.lpips import Lpips
from querysplat_cli.splat.similarity import limited_psnr, ssim_metric

METRICS = ("psnr", "ssim", "lpips")


@dataclass(frozen=True)
class Scores:
    """PSNR in dB; SSIM as in scikit-image, with an 11-pixel Gaussian window; LPIPS is None without its weights.

    What follows stands beside these three, and is None where it was not measured. `_cc` is of the picture with each
    channel mapped to the photo's by a slope and an offset, as gsplat's trainer scores. `_half` is of its right half
    after the 3 × 4 transform that fits the left half best, as Inria's code scores. `_fitted` is of the picture from a
    camera that was fitted to the scene, and never the score of a protocol. `flip` is LDR-FLIP's mean error (0 is best)
    and `ssimulacra2` SSIMULACRA2 (100 is best), both of pictures in 8 bits.
    """

    psnr: float
    ssim: float
    lpips: float | None
    psnr_cc: float | None = None
    ssim_cc: float | None = None
    lpips_cc: float | None = None
    psnr_half: float | None = None
    ssim_half: float | None = None
    lpips_half: float | None = None
    psnr_fitted: float | None = None
    ssim_fitted: float | None = None
    lpips_fitted: float | None = None
    flip: float | None = None
    ssimulacra2: float | None = None


ALL_METRICS = tuple(each.name for each in fields(Scores))


@dataclass(frozen=True)
class Meter:
    """What pictures are measured with: LPIPS where its weights are, and the further metrics that are asked for."""

    lpips: Lpips | None = None
    further: Sequence[FurtherMetric] = field(default=())

    @torch.no_grad()
    def compare(self, picture: Float[Tensor, "3 height width"], truth: Float[Tensor, "3 height width"]) -> Scores:
        """Scores of `picture` against `truth`, both in [0, 1]; every pixel counts."""
        everywhere = torch.ones(truth.shape[1:], dtype=torch.bool)
        corrected = channel_corrected(picture, truth, everywhere)
        left = left_half(everywhere)
        right = slice(int(left[0].sum()), None)
        half = matrix_corrected(picture, truth, left)[..., right]
        return Scores(
            *self.plain(picture, truth),
            *self.plain(corrected, truth),
            *self.plain(half, truth[..., right]),
            **{name: further_metric(name)(picture, truth) for name in self.further},
        )

    @torch.no_grad()
    def plain(
        self, picture: Float[Tensor, "3 height width"], truth: Float[Tensor, "3 height width"]
    ) -> tuple[float, float, float | None]:
        """PSNR, SSIM and LPIPS."""
        distance = float(self.lpips(picture[None], truth[None])) if self.lpips else None
        return limited_psnr(picture, truth), ssim_metric(picture, truth), distance
