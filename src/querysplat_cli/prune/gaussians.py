"""Gaussians that the photos do not need."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from querysplat_cli.queries.build import BORDER
from querysplat_cli.runtime.choices import Amount
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import SH_0, Gaussians
from querysplat_cli.splat.render import RenderSettings, render

SHARE = 0.5
"""What an automatic choice keeps. Optimisation makes up for the rest; what held-out views lose is in
docs/benchmarks.md."""
MENDED = 0.1
"""dB on the input views that a step makes up for."""
SCARCE = 100
"""Pixels of the photos for each Gaussian beyond which all are needed."""
HIDDEN = 0.01
"""Change of colour that a Gaussian at least stands for, of 1."""


@dataclass(frozen=True)
class Pruned:
    """Which of N Gaussians stay, and the PSNR (dB, input views) with all of them and without the others, before
    optimisation goes on."""

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
    """Leave out those of the least `importance`, down to those `target_count`; `psnr` scores Gaussians on the photos.

    An automatic choice leaves out nothing where `steps_left` of optimisation are too few to make up for it.
    """
    count = target_count(len(gaussians), amount, cameras)
    with torch.no_grad():
        order = importance(gaussians, cameras).argsort(descending=True, stable=True)
        kept = torch.zeros(len(order), dtype=torch.bool, device=order.device)
        kept[order[:count]] = True
        found = Pruned(kept, psnr(gaussians), psnr(gaussians[kept]))
    if amount == "auto" and found.psnr_before - found.psnr_after > MENDED * steps_left:
        return Pruned(torch.ones_like(kept), found.psnr_before, found.psnr_before)
    return found


def target_count(count: int, amount: Amount, cameras: Cameras) -> int:
    """How many of `count` Gaussians are kept for the photos of `cameras`."""
    if amount == "off":
        return count
    if amount == "auto":
        scarce = len(cameras) * cameras.height * cameras.width // SCARCE
        return max(int(SHARE * count), min(count, scarce))
    return min(count, amount)


def importance(gaussians: Gaussians, cameras: Cameras) -> Float[Tensor, "n"]:
    """How much of the pictures each Gaussian colours, W, times what goes with it, ‖ΔC‖ + `HIDDEN` W.

    W is its blending weight, summed over pixels; ΔC how pixels change without it. The last term is for those that
    coincide: without any one of them nothing changes, but the first must stay. A pixel's derivative by an opacity
    o is ΔC / o, since blending is linear in every α, and a backward pass from pixels of random sign gives ‖ΔC‖² in
    expectation, for all Gaussians at once. Pictures reach a little beyond their borders, where a camera
    between two others may look, and are brighter by half, so that what is black counts, too.
    """
    wider, settings = _wider(cameras), RenderSettings()
    random = torch.Generator().manual_seed(0)
    sh = gaussians.sh.detach().clone()
    sh[:, 0] += 0.5 / SH_0
    # No gradient passes the cap of α.
    opacities = gaussians.opacities.detach().clamp(max=0.99 * settings.alpha_max)
    scene = replace(gaussians.detach(), sh=sh.requires_grad_(), opacities=opacities.requires_grad_())
    weight, change = torch.zeros(2, len(gaussians)).to(sh)
    for view in range(len(wider)):
        with torch.enable_grad():
            picture = render(scene, wider[[view]], settings=settings).colour
            (by_sh,) = torch.autograd.grad(picture[:, 0].sum(), sh, retain_graph=True)
            signs = torch.randint(0, 2, picture.shape, generator=random).to(picture) * 2 - 1
            (by_opacity,) = torch.autograd.grad((picture * signs).sum(), opacities)
        weight += by_sh[:, 0, 0] / SH_0
        change += (by_opacity * opacities.detach()).square()
    return weight * (change.sqrt() + HIDDEN * weight)


def _wider(cameras: Cameras) -> Cameras:
    margin = math.ceil(BORDER * max(cameras.height, cameras.width))
    K = cameras.K.clone()
    K[:, :2, 2] += margin
    return replace(cameras, K=K, height=cameras.height + 2 * margin, width=cameras.width + 2 * margin)
