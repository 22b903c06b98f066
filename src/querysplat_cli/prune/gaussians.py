"""Gaussians that the photos do not need."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from querysplat_cli.model.anchors import BORDER
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import SH_0, Gaussians
from querysplat_cli.splat.render import RenderSettings, render

Amount = Literal["auto", "off"] | int
"""How many Gaussians stay: as many as are needed, all, or at most so many."""
SHARE = 0.5
"""What an automatic choice keeps. Optimisation makes up for the rest; what held-out views lose is in
docs/benchmarks.md."""
SCARCE = 100
"""Pixels of the photos for each Gaussian beyond which all are needed."""
HIDDEN = 0.01
"""What a Gaussian counts before others of its colour, beside one before nothing."""


@dataclass(frozen=True)
class Pruned:
    """Which of N Gaussians stay, and the PSNR (dB, input views) with all of them and without the others, before
    optimisation goes on."""

    kept: Bool[Tensor, "n"]
    psnr_before: float
    psnr_after: float


def prune(
    gaussians: Gaussians, cameras: Cameras, amount: Literal["auto"] | int, psnr: Callable[[Gaussians], float]
) -> Pruned:
    """Leave out those of the least `importance`, down to those `staying`; `psnr` scores Gaussians on the photos."""
    count = staying(len(gaussians), amount, cameras)
    with torch.no_grad():
        order = importance(gaussians, cameras).argsort(descending=True, stable=True)
        kept = torch.zeros(len(order), dtype=torch.bool, device=order.device)
        kept[order[:count]] = True
        return Pruned(kept, psnr(gaussians), psnr(gaussians[kept]))


def staying(count: int, amount: Amount, cameras: Cameras) -> int:
    """How many of `count` Gaussians are kept for the photos of `cameras`."""
    if amount == "off":
        return count
    if amount == "auto":
        scarce = len(cameras) * cameras.height * cameras.width // SCARCE
        return max(int(SHARE * count), min(count, scarce))
    return min(count, amount)


def importance(gaussians: Gaussians, cameras: Cameras) -> Float[Tensor, "n"]:
    """How much of the pictures each Gaussian colours, Σ w², times what goes with it: Σ |ΔC|² + `HIDDEN` Σ w².

    Sums are over pixels and channels, w are blending weights. The second term is for those that coincide: without any
    one of them nothing changes, but the first of them must stay. A pixel's derivative by an opacity o is ΔC / o,
    since blending is linear in every α; a backward pass from pixels of random sign gives the sums of squares in
    expectation, for all Gaussians at once. Pictures reach a little beyond their borders, where a camera between two
    others may look, and are brighter by half, so that what is black counts, too.
    """
    wider, settings = _wider(cameras), RenderSettings()
    random = torch.Generator().manual_seed(0)
    sh = gaussians.sh.detach().clone()
    sh[:, 0] += 0.5 / SH_0
    # No gradient passes the cap of α.
    opacities = gaussians.opacities.detach().clamp(max=0.99 * settings.alpha_max)
    leaves = sh.requires_grad_(), opacities.requires_grad_()
    scene = replace(gaussians.detach(), sh=sh, opacities=opacities)
    coloured, gone = torch.zeros(2, len(gaussians)).to(sh)
    for view in range(len(wider)):
        with torch.enable_grad():
            picture = render(scene, wider[[view]], settings=settings).colour
            signs = torch.randint(0, 2, picture.shape, generator=random).to(picture) * 2 - 1
            by_sh, by_opacity = torch.autograd.grad((picture * signs).sum(), leaves)
        coloured += (by_sh[:, 0] / SH_0).square().sum(1)
        gone += (by_opacity * opacities.detach()).square()
    return coloured * (gone + HIDDEN * coloured)


def _wider(cameras: Cameras) -> Cameras:
    margin = math.ceil(BORDER * max(cameras.height, cameras.width))
    K = cameras.K.clone()
    K[:, :2, 2] += margin
    return replace(cameras, K=K, height=cameras.height + 2 * margin, width=cameras.width + 2 * margin)
