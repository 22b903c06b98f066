"""Working pictures no larger than the detail in the photos needs."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np

from querysplat_cli.prune.policy import PRUNE_POLICY
from querysplat_cli.scene.decoding import reduced
from querysplat_cli.scene.views import Photo


@dataclass(frozen=True)
class Blurred:
    """The photos show nothing finer than pictures whose longer side is `size` pixels.

    Enlarged to the `usual` size, the worst of them differs from the picture of that size by `psnr` dB.
    """

    size: int
    usual: int
    psnr: float


def blurred(photos: Sequence[Photo], usual: int) -> Blurred | None:
    """The smallest size at which no photo loses detail against the `usual` size; None where some photo needs that."""
    picture = cache(lambda row: reduced(photos[row].pixels, usual))  # few are looked at where the first are sharp
    for share in PRUNE_POLICY.size_shares:
        size = round(share * usual)
        if size < PRUNE_POLICY.smallest_size:
            continue
        worst = np.inf
        for row in range(len(photos)):
            worst = min(worst, _psnr(picture(row), size / usual))
            if worst < PRUNE_POLICY.same_psnr:
                break
        else:
            return Blurred(size, usual, worst)
    return None


def _psnr(picture: np.ndarray, share: float) -> float:
    smaller = cv2.resize(picture.astype(np.float32), None, fx=share, fy=share, interpolation=cv2.INTER_AREA)
    again = cv2.resize(smaller, (picture.shape[1], picture.shape[0]), interpolation=cv2.INTER_CUBIC)
    error = float(np.square(again - picture).mean())
    return 10 * float(np.log10(255**2 / max(error, 1e-6)))
