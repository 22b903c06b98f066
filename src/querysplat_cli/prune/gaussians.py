"""Pruning: the Gaussians with the least influence on the renders are removed."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from querysplat_cli.prune.policy import PRUNE_POLICY
from querysplat_cli.queries.policy import QUERY_POLICY
from querysplat_cli.runtime.choices import Amount
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import SH_0, Gaussians
from querysplat_cli.splat.blending_weights import blending_weights
from querysplat_cli.splat.render import RenderSettings, render


@dataclass(frozen=True)
class Pruned:
    """Which of N Gaussians stay, and the PSNR (dB, input views) before and after the others were removed."""

    kept: Bool[Tensor, "n"]
    psnr_before: float
    psnr_after: float


def prune(
    gaussians: Gaussians,
    cameras: Cameras,
    amount: Literal["auto"] | int,
    psnr: Callable[[Gaussians], float],
    steps_left: float,
) -> Pruned:
    """Keep the `target_count` Gaussians of the largest `importance`; `psnr` scores Gaussians on the input views (dB).

    An automatic choice removes none where `steps_left` of optimisation are too few to make up for the loss.
    """
    count = target_count(len(gaussians), amount, cameras)
    with torch.no_grad():
        order = importance(gaussians, cameras).argsort(descending=True, stable=True)
        kept = torch.zeros(len(order), dtype=torch.bool, device=order.device)
        kept[order[:count]] = True
        found = Pruned(kept, psnr(gaussians), psnr(gaussians[kept]))
    if amount == "auto" and found.psnr_before - found.psnr_after > PRUNE_POLICY.psnr_per_step * steps_left:
        return Pruned(torch.ones_like(kept), found.psnr_before, found.psnr_before)
    return found


def target_count(count: int, amount: Amount, cameras: Cameras) -> int:
    """How many of `count` Gaussians stay, for photos of the size and number of `cameras`."""
    if amount == "off":
        return count
    if amount == "auto":
        scarce = len(cameras) * cameras.height * cameras.width // PRUNE_POLICY.pixels_per_gaussian
        return max(int(PRUNE_POLICY.share_kept * count), min(count, scarce))
    return min(count, amount)


def importance(gaussians: Gaussians, cameras: Cameras) -> Float[Tensor, "n"]:
    """The influence of each Gaussian on the renders: W·(‖ΔC‖ + h·W), where h is `PrunePolicy.hidden_change`.

    W is the Gaussian's blending weight, summed over pixels, and ΔC the change of the pixels without it. The term h·W is
    for Gaussians that coincide: removing any one of them changes nothing, but the first must stay. Blending is linear
    in every α, so a pixel's derivative with respect to an opacity o is ΔC / o. One backward pass from pixels of random
    sign gives ‖ΔC‖² in expectation, for all Gaussians at once. The pictures are wider than the photos, because a camera
    between two others may show what lies beyond their borders. They are brighter by half, so that black Gaussians
    count.
    """
    wider = _wider(cameras)
    random = torch.Generator().manual_seed(0)
    sh = gaussians.sh.detach().clone()
    sh[:, 0] += 0.5 / SH_0
    # An opacity at the cap of α would get no gradient.
    opacities = gaussians.opacities.detach().clamp(max=0.99 * RenderSettings().alpha_max)
    scene = replace(gaussians.detach(), sh=sh, opacities=opacities.requires_grad_())
    weight, change = blending_weights(scene, wider), torch.zeros_like(opacities)
    for view in range(len(wider)):
        with torch.enable_grad():
            picture = render(scene, wider[[view]]).colour
            signs = torch.randint(0, 2, picture.shape, generator=random).to(picture) * 2 - 1
            (by_opacity,) = torch.autograd.grad((picture * signs).sum(), opacities)
        change += (by_opacity * opacities.detach()).square()
    return weight * (change.sqrt() + PRUNE_POLICY.hidden_change * weight)


def _wider(cameras: Cameras) -> Cameras:
    margin = math.ceil(QUERY_POLICY.border * max(cameras.height, cameras.width))
    K = cameras.K.clone()
    K[:, :2, 2] += margin
    return replace(cameras, K=K, height=cameras.height + 2 * margin, width=cameras.width + 2 * margin)
