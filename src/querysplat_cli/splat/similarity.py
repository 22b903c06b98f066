"""PSNR, SSIM, and the photometric loss of training and test-time optimisation."""

from collections.abc import Callable
from typing import Any

import cv2
import numba as nb
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F

RADIUS = 5
SIGMA = 1.5
C1, C2 = 0.01**2, 0.03**2
SSIM_WEIGHT = 0.2
"""Weight of (1 − SSIM)/2 beside L1 (paper, section 3.4)."""
SAMPLE_CORRECTION = 121 / 120
"""Makes variances unbiased over 11 × 11 samples, as scikit-image does."""


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


def ssim_map(
    image: Float[Tensor, "n c h w"], target: Float[Tensor, "n c h w"], *, correction: float = 1.0
) -> Float[Tensor, "n c h w"]:
    """SSIM of every pixel (Wang 2004): 11-tap Gaussian window, each channel alone, zeros beyond the border.

    Plain torch, in any precision. `correction` multiplies variances and covariance.
    """
    channels = image.shape[1]
    weights = torch.from_numpy(taps()).to(image)
    row = weights.expand(channels, 1, 1, -1)
    column = weights[:, None].expand(channels, 1, -1, 1)

    def blur(part: Tensor) -> Tensor:
        across = F.conv2d(part, row, padding=(0, RADIUS), groups=channels)
        return F.conv2d(across, column, padding=(RADIUS, 0), groups=channels)

    return _similarity(image, target, blur, correction)


def ssim_metric(image: Float[Tensor, "3 h w"], target: Float[Tensor, "3 h w"]) -> float:
    """The reported SSIM: scikit-image's with an 11-pixel Gaussian window, mean over the interior.

    A picture smaller than the window has no interior; the mean is then over all pixels.
    """
    a, b = (picture.detach().cpu().double() for picture in (image, target))
    similarity = torch.stack([_similarity(*planes, _blurred, SAMPLE_CORRECTION) for planes in zip(a, b, strict=True)])
    inside = similarity[:, RADIUS:-RADIUS, RADIUS:-RADIUS]
    return float(inside.mean() if inside.numel() else similarity.mean())


def _similarity(image: Tensor, target: Tensor, blur: Callable[[Tensor], Tensor], correction: float) -> Tensor:
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
) -> Float[Tensor, ""]:
    """L1 + 0.2·(1 − SSIM)/2 with zero padding, mean over the pixels of `mask`; only `image` gets a gradient.

    Views have equal weight, whatever the size of their masks. float32 on a CPU takes the compiled kernel.
    """
    target = target.detach()
    if mask is None:
        mask = torch.ones_like(image[:, 0], dtype=torch.bool)
    if image.dtype == torch.float32 and image.device.type == "cpu":
        return _Photometric.apply(image, target, mask)
    loss = (image - target).abs() + SSIM_WEIGHT * (1 - ssim_map(image, target)) / 2
    count = mask.sum((1, 2)).clamp_min(1)
    return ((loss.mean(1) * mask).sum((1, 2)) / count).mean()


class _Photometric(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor, mask: Tensor) -> Tensor:
        views, _, height, width = image.shape
        gradient = np.empty((views, 3, height, width), np.float32)
        losses = np.zeros((views, 3))
        share = 1 / (3 * views * mask.sum((1, 2)).clamp_min(1).double())
        loss_and_gradient(
            image.detach().contiguous().numpy(),
            target.contiguous().numpy(),
            mask.contiguous().numpy(),
            share.numpy(),
            taps().astype(np.float32),
            losses,
            gradient,
        )
        ctx.gradient = torch.from_numpy(gradient)
        return image.new_tensor(losses.sum())

    @staticmethod
    def backward(ctx: Any, given: Tensor) -> tuple[Tensor | None, ...]:
        return given * ctx.gradient, None, None


@nb.njit(cache=True, error_model="numpy", parallel=True)
def loss_and_gradient(
    image: np.ndarray,
    target: np.ndarray,
    mask: np.ndarray,
    share: np.ndarray,
    weights: np.ndarray,
    losses: np.ndarray,
    gradient: np.ndarray,
) -> None:
    for job in nb.prange(image.shape[0] * 3):
        view, channel = job // 3, job % 3
        losses[view, channel] = _plane(
            image[view, channel], target[view, channel], mask[view], share[view], weights, gradient[view, channel]
        )


@nb.njit(cache=True, error_model="numpy", fastmath={"contract"}, forceinline=True)
def _plane(
    a: np.ndarray, b: np.ndarray, mask: np.ndarray, share: float, weights: np.ndarray, gradient: np.ndarray
) -> float:
    """Loss of one channel of one picture, times `share`, and its gradient with respect to `a`.

    With m the blur, SSIM = f(m(a), m(b), m(a²), m(b²), m(ab)) pixel by pixel; the blur is its own transpose,
    so the gradient is m(∂f/∂m(a)) + 2a·m(∂f/∂m(a²)) + b·m(∂f/∂m(ab)).
    """
    height, width = a.shape
    half, whole = np.float32(0.5 * SSIM_WEIGHT * share), np.float32(share)
    one, two, zero, c1, c2 = np.float32(1), np.float32(2), np.float32(0), np.float32(C1), np.float32(C2)
    maps = np.empty((5, height, width), np.float32)
    for y in range(height):
        for x in range(width):
            maps[0, y, x], maps[1, y, x] = a[y, x], b[y, x]
            maps[2, y, x], maps[3, y, x], maps[4, y, x] = a[y, x] * a[y, x], b[y, x] * b[y, x], a[y, x] * b[y, x]
    scratch = np.empty((height, width), np.float32)
    _blur(maps, scratch, weights)
    total = 0.0
    for y in range(height):
        for x in range(width):
            weight = half if mask[y, x] else zero
            mean_a, mean_b = maps[0, y, x], maps[1, y, x]
            raw_a, raw_b = maps[2, y, x] - mean_a * mean_a, maps[3, y, x] - mean_b * mean_b
            light_up = two * mean_a * mean_b + c1
            light_down = mean_a * mean_a + mean_b * mean_b + c1
            structure_up = two * (maps[4, y, x] - mean_a * mean_b) + c2
            structure_down = max(raw_a, zero) + max(raw_b, zero) + c2
            light, structure = light_up / light_down, structure_up / structure_down
            similarity = min(max(light * structure, -one), one)
            total += weight * (one - similarity)
            weight = -weight if similarity == light * structure else zero
            by_square = -weight * light * structure / structure_down if raw_a >= zero else zero
            by_product = weight * light * two / structure_down
            by_mean = weight * structure * two * (mean_b - light * mean_a) / light_down
            maps[0, y, x] = by_mean - two * mean_a * by_square - mean_b * by_product
            maps[1, y, x], maps[2, y, x] = by_square, by_product
    _blur(maps[:3], scratch, weights)
    for y in range(height):
        for x in range(width):
            value = maps[0, y, x] + two * a[y, x] * maps[1, y, x] + b[y, x] * maps[2, y, x]
            difference = a[y, x] - b[y, x]
            if mask[y, x]:
                total += whole * abs(difference)
                value += whole if difference > zero else (-whole if difference < zero else zero)
            gradient[y, x] = value
    return total


@nb.njit(cache=True, error_model="numpy", fastmath={"contract"}, forceinline=True)
def _blur(planes: np.ndarray, scratch: np.ndarray, weights: np.ndarray) -> None:
    """Blur each of `planes` in place with the separable window, zeros beyond the border."""
    height, width = scratch.shape
    taps = len(weights)
    row = np.zeros(width + taps - 1, np.float32)
    for plane in planes:
        for y in range(height):
            out = scratch[y]
            for x in range(width):
                out[x], row[RADIUS + x] = np.float32(0), plane[y, x]
            for k in range(taps):
                w = weights[k]
                for x in range(width):
                    out[x] += w * row[x + k]
        for y in range(height):
            out = plane[y]
            for x in range(width):
                out[x] = np.float32(0)
            for k in range(max(0, RADIUS - y), min(taps, height + RADIUS - y)):
                w = weights[k]
                source = scratch[y + k - RADIUS]
                for x in range(width):
                    out[x] += w * source[x]
