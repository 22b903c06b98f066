"""Depth by windows that are many times as wide, where the usual ones find none.

A window of a few pixels of leaves looks like any other one, and from another side its leaves cover each other in other
ways. The crown of the tree still matches. So stereo measures pictures that are a few times as small, too.
"""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from querysplat_cli.encoders.classical.depth_policy import DEPTH_POLICY
from querysplat_cli.encoders.classical.neighbours import InverseRange
from querysplat_cli.encoders.classical.patchmatch import Source
from querysplat_cli.encoders.classical.stereo import Measurement, measure
from querysplat_cli.runtime.progress import silent


def measure_wide(
    photos: Sequence[Source], sources: Sequence[list[int]], ranges: Sequence[InverseRange], fine: Measurement
) -> Measurement:
    """What wide windows find, whose guesses may stand where narrow ones (`fine`) found nothing.

    Inverse depth is 0 where wide windows say nothing, either. The narrowest of them that is confirmed counts. Where
    none is, the widest does, with confidence 0. A window that holds much of what `fine` confirms is not asked: it
    matches as the surface beside the pixel does.
    """
    policy = DEPTH_POLICY
    height, width = fine.inverse.shape[1:]
    inverse, confidence = np.zeros_like(fine.inverse), np.zeros_like(fine.confidence)
    known = (fine.confidence >= policy.guess_confidence).astype(np.float32)
    factors = [factor for factor in policy.wider if min(height, width) >= policy.wide_side * factor]
    for factor in factors:
        small = measure([_reduced(photo, factor) for photo in photos], sources, ranges, silent)
        window = (factor * (2 * policy.refinement_reach + 1),) * 2
        for v in range(len(photos)):
            own = cv2.blur(known[v], window, borderType=cv2.BORDER_REPLICATE) < policy.wide_known
            sure = cv2.resize(small.confidence[v], (width, height), interpolation=cv2.INTER_NEAREST)
            there = own & (inverse[v] == 0)
            if factor < factors[-1]:
                there &= sure >= policy.guess_confidence
            inverse[v][there] = cv2.resize(small.inverse[v], (width, height), interpolation=cv2.INTER_LINEAR)[there]
            confidence[v][there] = policy.wide_confidence * np.where(sure < policy.guess_confidence, 0, sure)[there]
    return Measurement(inverse, confidence)


def _reduced(photo: Source, factor: int) -> Source:
    """The same view with pixels `factor` times as large. A pixel has no picture where a part of it has none."""
    sides = [2 * round(side / factor / 2) for side in photo.grey.shape]
    rows, columns = (small / side for small, side in zip(sides, photo.grey.shape, strict=True))
    lost = cv2.resize((photo.grey < 0).astype(np.float32), sides[::-1], interpolation=cv2.INTER_AREA)
    grey = cv2.resize(photo.grey, sides[::-1], interpolation=cv2.INTER_AREA)
    grey[lost > 0] = -1
    return replace(photo, grey=grey, K=np.diag([columns, rows, 1.0]) @ photo.K, inverse=np.zeros_like(grey))
