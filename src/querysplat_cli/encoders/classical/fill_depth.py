"""Depth where nothing could be measured: from the surroundings, but not across the edges of the photo."""

import cv2
import numpy as np

from querysplat_cli.encoders.classical.depth_policy import DEPTH_POLICY
from querysplat_cli.scene.local_planes import local_planes


def fill_depth(inverse: np.ndarray, confidence: np.ndarray, image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Inverse depth [height, width] in which unconfirmed pixels continue the planes of the confirmed ones around them.

    `image` [height, width, 3] in [0, 1] guides an edge-preserving least-squares filter (Min et al. 2014), which
    weights the surroundings of a pixel by their `confidence`. Confirmed pixels keep their depth.
    """
    policy = DEPTH_POLICY
    guide = (image * 255).round().astype(np.uint8)
    smooth = cv2.ximgproc.createFastGlobalSmootherFilter(guide, policy.fill_smoothness, policy.fill_edge)
    guess = np.where(mask, policy.guess_weight, 1e-6).astype(np.float32)
    sure = np.where(mask, confidence, 0).astype(np.float32)
    y, x = np.indices(inverse.shape) + 0.5
    planes = local_planes(inverse, sure, smooth.filter, policy.fill_ridge)
    continued = planes.weight * planes.at(x, y, policy.fill_tilt)
    spread = (continued + smooth.filter(guess * inverse)) / (planes.weight + smooth.filter(guess))
    share = np.clip(confidence * 2, 0, 1)
    return (share * inverse + (1 - share) * spread).astype(np.float32)
