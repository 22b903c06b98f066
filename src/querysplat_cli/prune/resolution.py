"""Working pictures no larger than what the photos show."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from querysplat_cli.scene.photos import reduced
from querysplat_cli.scene.views import Photo

SHARES = (0.5, 0.6, 0.7, 0.85)
"""Of the usual size, smallest first."""
SAME = 45.0
"""dB between a picture and itself, reduced and enlarged again, from which nothing is lost: 1.4 of 255 levels (RMS)."""
SMALLEST = 160
"""Longer side of working pictures, in pixels, below which stereo finds too little."""


@dataclass(frozen=True)
class Blurred:
    """Photos show nothing finer than pictures of `size` pixels, their longer side; against those of the `usual`
    size, enlarged again, the worst differs by `psnr` dB."""

    size: int
    usual: int
    psnr: float


def blurred(photos: Sequence[Photo], usual: int) -> Blurred | None:
    """The smallest size at which no photo loses anything that it shows at the `usual` one; None where all need that."""
    pictures = [reduced(photo.pixels, usual) for photo in photos]
    for share in SHARES:
        size = round(share * usual)
        if size < SMALLEST:
            continue
        worst = np.inf
        for picture in pictures:
            worst = min(worst, _psnr(picture, size / usual))
            if worst < SAME:
                break
        else:
            return Blurred(size, usual, worst)
    return None


def _psnr(picture: np.ndarray, share: float) -> float:
    smaller = cv2.resize(picture.astype(np.float32), None, fx=share, fy=share, interpolation=cv2.INTER_AREA)
    again = cv2.resize(smaller, (picture.shape[1], picture.shape[0]), interpolation=cv2.INTER_CUBIC)
    error = float(np.square(again - picture).mean())
    return 10 * float(np.log10(255**2 / max(error, 1e-6)))
