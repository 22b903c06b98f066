"""Spherical harmonics (SH) that hardly change the renders are left out."""

from collections.abc import Callable
from dataclasses import dataclass, replace

from querysplat_cli.prune.policy import PRUNE_POLICY
from querysplat_cli.scene.gaussians import Gaussians


@dataclass(frozen=True)
class IdleBands:
    """How many SH bands were left out of every Gaussian, and what that costs on the input views (dB)."""

    count: int
    psnr_lost: float


def without_idle_bands(gaussians: Gaussians, psnr: Callable[[Gaussians], float]) -> tuple[Gaussians, IdleBands | None]:
    """The Gaussians at the lowest SH degree that costs at most `PrunePolicy.psnr_of_bands`, and what was left out.

    `psnr` scores Gaussians on the input views (dB).
    """
    whole = psnr(gaussians)
    for degree in range(gaussians.sh_degree):
        fewer = replace(gaussians, sh=gaussians.sh[:, : (degree + 1) ** 2])
        lost = whole - psnr(fewer)
        if lost <= PRUNE_POLICY.psnr_of_bands:
            return fewer, IdleBands(gaussians.sh.shape[1] - fewer.sh.shape[1], lost)
    return gaussians, None
