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
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.splat.render import contributions

Amount = Literal["auto", "off"] | int
"""How many Gaussians stay: as many as count, all, or at most so many."""
LOSS = 0.02
"""dB that an automatic choice may cost on the input views before optimisation goes on; what held-out views lose
by it is in docs/benchmarks.md."""
HALVINGS = 5
"""The share is found to 1/32."""


@dataclass(frozen=True)
class Pruned:
    """Which of N Gaussians stay, and the PSNR (dB, input views) with all of them and without the others."""

    kept: Bool[Tensor, "n"]
    psnr_before: float
    psnr_after: float


def prune(
    gaussians: Gaussians, cameras: Cameras, amount: Literal["auto"] | int, psnr: Callable[[Gaussians], float]
) -> Pruned:
    """Leave out those of the least `weights`.

    "auto" leaves out as many as cost at most `LOSS` by `psnr`, which scores Gaussians on the photos; a number
    is that of those that stay.
    """
    with torch.no_grad():
        everything = psnr(gaussians)
        order = weights(gaussians, cameras).argsort(stable=True)
        if amount != "auto":
            kept = _all_but(order, max(0, len(order) - amount))
            return Pruned(kept, everything, psnr(gaussians[kept]))
        least, most, found = 0.0, 1.0, Pruned(_all_but(order, 0), everything, everything)
        for _ in range(HALVINGS):
            share = (least + most) / 2
            kept = _all_but(order, int(share * len(order)))
            after = psnr(gaussians[kept])
            if everything - after <= LOSS:
                least, found = share, Pruned(kept, everything, after)
            else:
                most = share
    return found


def weights(gaussians: Gaussians, cameras: Cameras) -> Float[Tensor, "n"]:
    """`contributions` to the pictures and to what lies a little beyond their borders, where a camera between two
    others may look."""
    margin = math.ceil(BORDER * max(cameras.height, cameras.width))
    K = cameras.K.clone()
    K[:, :2, 2] += margin
    wider = replace(cameras, K=K, height=cameras.height + 2 * margin, width=cameras.width + 2 * margin)
    return contributions(gaussians, wider)


def _all_but(order: Tensor, count: int) -> Bool[Tensor, "n"]:
    kept = torch.ones(len(order), dtype=torch.bool, device=order.device)
    kept[order[:count]] = False
    return kept
