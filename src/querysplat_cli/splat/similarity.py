"""PSNR, SSIM, and the photometric loss of training and test-time optimisation."""

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F

from querysplat_cli.splat.compiled_similarity import C1, C2, RADIUS, SSIM_WEIGHT, photometric_sums
from querysplat_cli.splat.conventions import EQUAL_PSNR

SIGMA = 1.5
SAMPLE_CORRECTION = 121 / 120
"""Makes variances unbiased over 11 × 11 samples, as scikit-image does."""
STRIP = 96
"""Rows of a picture that one thread takes, at least. Strips share their borders, so that small ones cost more."""


def taps() -> np.ndarray:
    """The 11 weights of the Gaussian window, which add up to 1."""
    weights = np.exp(-0.5 * (np.arange(-RADIUS, RADIUS + 1) / SIGMA) ** 2)
    return weights / weights.sum()


def psnr(
    image: Float[Tensor, "3 h w"], target: Float[Tensor, "3 h w"], mask: Bool[Tensor, "h w"] | None = None
) -> float:
    """Peak signal-to-noise ratio in dB over the pixels of `mask`; infinite for equal pictures."""
    error = (image - target).square().mean(0)
    mean = error.mean() if mask is None else error[mask].mean()
    return float(-10 * torch.log10(mean))


def limited_psnr(
    image: Float[Tensor, "3 h w"], target: Float[Tensor, "3 h w"], mask: Bool[Tensor, "h w"] | None = None
) -> float:
    """`psnr`, of at most `EQUAL_PSNR`."""
    return min(psnr(image, target, mask), EQUAL_PSNR)


def ssim_map(image: Float[Tensor, "n c h w"], target: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
    """SSIM of every pixel (Wang 2004): 11-tap Gaussian window, each channel alone, zeros beyond the border.

    Plain torch, in any precision.
    """
    channels = image.shape[1]
    weights = torch.from_numpy(taps()).to(image)
    row = weights.expand(channels, 1, 1, -1)
    column = weights[:, None].expand(channels, 1, -1, 1)

    def blur(part: Tensor) -> Tensor:
        across = F.conv2d(part, row, padding=(0, RADIUS), groups=channels)
        return F.conv2d(across, column, padding=(RADIUS, 0), groups=channels)

    return _similarity(image, target, blur, 1.0)


def ssim_metric(
    image: Float[Tensor, "3 h w"], target: Float[Tensor, "3 h w"], mask: Bool[Tensor, "h w"] | None = None
) -> float:
    """The reported SSIM: scikit-image's with an 11-pixel Gaussian window, mean over the interior.

    Only pixels of `mask` count; around them `image` is taken to be `target`, which windows reach. Where the interior
    has none, because the picture is smaller than the window, the mean is over all pixels that count.
    """
    if mask is None:
        mask = torch.ones_like(image[0], dtype=torch.bool)
    a, b = (picture.detach().cpu().double() for picture in (torch.where(mask, image, target), target))
    similarity = torch.stack([_similarity(*planes, _blurred, SAMPLE_CORRECTION) for planes in zip(a, b, strict=True)])
    counts = mask.cpu()
    inside = similarity[:, RADIUS:-RADIUS, RADIUS:-RADIUS][:, counts[RADIUS:-RADIUS, RADIUS:-RADIUS]]
    return float(inside.mean() if inside.numel() else similarity[:, counts].mean())


def _similarity(image: Tensor, target: Tensor, blur: Callable[[Tensor], Tensor], correction: float) -> Tensor:
    """`correction` multiplies variances and covariance."""
    mean_a, mean_b = blur(image), blur(target)
    variance_a = (blur(image * image) - mean_a * mean_a).clamp_min(0) * correction
    variance_b = (blur(target * target) - mean_b * mean_b).clamp_min(0) * correction
    covariance = (blur(image * target) - mean_a * mean_b) * correction
    light = (2 * mean_a * mean_b + C1) / (mean_a * mean_a + mean_b * mean_b + C1)
    structure = (2 * covariance + C2) / (variance_a + variance_b + C2)
    return (light * structure).clamp(-1, 1)


def _blurred(plane: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """The blur of `ssim_map` for one plane, without a gradient and many times as fast."""
    return torch.from_numpy(cv2.sepFilter2D(plane.numpy(), -1, taps(), taps(), borderType=cv2.BORDER_CONSTANT))


def photometric_loss(
    image: Float[Tensor, "views 3 height width"],
    target: Float[Tensor, "views 3 height width"],
    mask: Bool[Tensor, "views height width"] | None = None,
    ssim_weight: float = SSIM_WEIGHT,
) -> Float[Tensor, ""]:
    """L1 + `ssim_weight`·(1 − SSIM)/2, mean over the pixels of `mask`; only `image` gets a gradient.

    SSIM's windows find zeros in both pictures outside of the mask and beyond the borders. Views have equal weight,
    whatever the size of their masks. float32 on a CPU takes the compiled kernel.
    """
    target = target.detach()
    if mask is None:
        mask = torch.ones_like(image[:, 0], dtype=torch.bool)
    if image.dtype == torch.float32 and image.device.type == "cpu":
        return _Photometric.apply(image, target, mask, ssim_weight)
    image, target = (torch.where(mask[:, None], picture, 0) for picture in (image, target))
    loss = (image - target).abs() + ssim_weight * (1 - ssim_map(image, target)) / 2
    count = mask.sum((1, 2)).clamp_min(1)
    return ((loss.mean(1) * mask).sum((1, 2)) / count).mean()


def photometric_value(
    image: Float[Tensor, "views 3 height width"],
    target: Float[Tensor, "views 3 height width"],
    mask: Bool[Tensor, "views height width"],
    ssim_weight: float,
) -> tuple[float, float]:
    """`photometric_loss`, and the mean squared error of the clamped picture over the pixels of `mask`.

    No gradient is computed, which takes less than half of the time.
    """
    if image.dtype != torch.float32 or image.device.type != "cpu":
        errors = (image.clamp(0, 1) - target).square().mean(1)
        return float(photometric_loss(image, target, mask, ssim_weight)), float(errors[mask].mean())
    return _means(image, target, mask, ssim_weight, np.empty((0, 3, 0, 0), np.float32))


class _Photometric(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor, mask: Tensor, ssim_weight: float) -> Tensor:
        gradient = np.empty(tuple(image.shape), np.float32)
        loss, _ = _means(image, target, mask, ssim_weight, gradient)
        ctx.gradient = torch.from_numpy(gradient)
        return image.new_tensor(loss)

    @staticmethod
    def backward(ctx: Any, given: Tensor) -> tuple[Tensor | None, ...]:
        return ctx.gradient if given == 1 else given * ctx.gradient, None, None, None


def _means(
    image: Tensor, target: Tensor, mask: Tensor, ssim_weight: float, gradient: np.ndarray
) -> tuple[float, float]:
    """The loss, and the mean squared error; fills `gradient` unless it has no views."""
    views, _, height, _ = image.shape
    strips = max(1, height // STRIP)
    masks = mask.contiguous().numpy()
    counts = np.array([np.count_nonzero(each) for each in masks])
    sums = np.zeros((views * 3 * strips, 2))
    photometric_sums(
        image.detach().contiguous().numpy(),
        target.contiguous().numpy(),
        masks,
        1 / (3 * views * np.maximum(counts, 1)),
        ssim_weight,
        taps().astype(np.float32),
        strips,
        sums,
        gradient,
    )
    loss, squared = sums.sum(0)
    return float(loss), float(squared / max(1, 3 * counts.sum()))
