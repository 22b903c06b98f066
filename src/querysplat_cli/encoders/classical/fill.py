"""Depth where nothing could be measured: from the extend_borders, and not across the edges of the photo."""

import cv2
import numpy as np

REACH = 4000.0
"""Smoothness of the fill: how far a measured depth spreads over even colour."""
EDGE = 6.0
"""Colour difference (of 255) over which it does not spread."""
TRUST_IN_GUESS = 1e-4
"""Weight of an unconfirmed depth beside a confirmed one's 1: it counts where nothing else does."""


def fill(inverse: np.ndarray, confidence: np.ndarray, image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Inverse depth [height, width] in which unconfirmed pixels follow their confirmed extend_borders.

    `image` [height, width, 3] in [0, 1] guides an edge-preserving least-squares filter (Min et al. 2014) of
    the confidence-weighted inverse depth; confirmed pixels keep what was measured.
    """
    weight = np.where(mask, confidence + TRUST_IN_GUESS, 1e-6).astype(np.float32)
    guide = (image * 255).round().astype(np.uint8)
    smooth = cv2.ximgproc.createFastGlobalSmootherFilter(guide, REACH, EDGE)
    spread = smooth.filter(inverse * weight) / np.maximum(smooth.filter(weight), 1e-9)
    share = np.clip(confidence * 2, 0, 1)
    return (share * inverse + (1 - share) * spread).astype(np.float32)
