"""Spherical harmonics that the photos do not need."""

from collections.abc import Callable
from dataclasses import dataclass, replace

from querysplat_cli.scene.gaussians import Gaussians

LOSS = 0.02
"""dB that leaving them out may cost on the input views."""


@dataclass(frozen=True)
class IdleBands:
    """How many SH bands were left out of every Gaussian, and what that costs on the input views (dB)."""

    count: int
    psnr_lost: float


def without_idle_bands(gaussians: Gaussians, psnr: Callable[[Gaussians], float]) -> tuple[Gaussians, IdleBands | None]:
    """The lowest degree that costs at most `LOSS` by `psnr`, and what was left out."""
    everything = psnr(gaussians)
    for degree in range(gaussians.sh_degree):
        fewer = replace(gaussians, sh=gaussians.sh[:, : (degree + 1) ** 2])
        lost = everything - psnr(fewer)
        if lost <= LOSS:
            return fewer, IdleBands(gaussians.sh.shape[1] - fewer.sh.shape[1], lost)
    return gaussians, None
