"""Depth where nothing could be measured: from the surroundings, but not across the edges of the photo."""

import cv2
import numpy as np

from querysplat_cli.encoders.classical.policy import DEPTH_POLICY


def fill_depth(inverse: np.ndarray, confidence: np.ndarray, image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Inverse depth [height, width] in which unconfirmed pixels follow the confirmed ones around them.

    `image` [height, width, 3] in [0, 1] guides an edge-preserving least-squares filter (Min et al. 2014) of the
    inverse depth, weighted by its `confidence`. Confirmed pixels keep their depth.
    """
    policy = DEPTH_POLICY
    weight = np.where(mask, confidence + policy.guess_weight, 1e-6).astype(np.float32)
    guide = (image * 255).round().astype(np.uint8)
    smooth = cv2.ximgproc.createFastGlobalSmootherFilter(guide, policy.fill_smoothness, policy.fill_edge)
    spread = smooth.filter(inverse * weight) / np.maximum(smooth.filter(weight), 1e-9)
    share = np.clip(confidence * 2, 0, 1)
    return (share * inverse + (1 - share) * spread).astype(np.float32)
