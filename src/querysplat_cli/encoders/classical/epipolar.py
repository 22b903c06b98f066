"""How well cameras agree with the matches between their photos."""

from dataclasses import dataclass

import cv2
import numpy as np

from querysplat_cli.encoders.classical.matches import Matches, Pair
from querysplat_cli.encoders.classical.policy import CAMERA_POLICY
from querysplat_cli.encoders.classical.sparse_model import SparseModel
from querysplat_cli.scene.cameras import PhotoCamera


@dataclass(frozen=True)
class Support:
    """How well matches support a model.

    `explained` of all `matches` between its photos agree with its cameras. `coverage` is the share of the matched
    features that became points.
    """

    explained: int
    matches: int
    coverage: float

    @property
    def share(self) -> float:
        return self.explained / self.matches if self.matches else 1.0

    @property
    def sound(self) -> bool:
        return self.share >= CAMERA_POLICY.agreeing_share and self.coverage >= CAMERA_POLICY.covered_share

    @property
    def score(self) -> float:
        """Larger for the better of two models of the same photos."""
        return self.explained * min(1.0, self.coverage / CAMERA_POLICY.covered_share)


def epipolar_support(model: SparseModel, matches: Matches) -> Support:
    """How many verified matches lie within `epipolar_tolerance` of their epipolar lines.

    Each pair was verified with a geometry of its own. So a folded or bent model contradicts the matches, even where
    the reprojection error of its own points is small.
    """
    explained = total = 0
    matched = dict.fromkeys(model.cameras, 1)
    for pair in matches.pairs:
        if pair.first in model.cameras and pair.second in model.cameras:
            cameras = model.cameras[pair.first], model.cameras[pair.second]
            explained += int((epipolar_error(pair, *cameras) < CAMERA_POLICY.epipolar_tolerance).sum())
            total += len(pair)
            for photo in pair.ends:
                matched[photo] = max(matched[photo], len(pair))
    coverage = sum(len(seen) for seen in model.seen.values()) / sum(matched.values())
    return Support(explained, total, coverage)


def median_epipolar_error(model: SparseModel, matches: Matches) -> float | None:
    """The median distance of matches from their epipolar lines, in longer sides of a photo; None without matches.

    Unlike the reprojection error of points, it does not leave out the matches that fit badly.
    """
    shares = []
    for pair in matches.pairs:
        if pair.first in model.cameras and pair.second in model.cameras:
            first, second = model.cameras[pair.first], model.cameras[pair.second]
            shares.append(epipolar_error(pair, first, second) / max(first.height, first.width))
    return float(np.median(np.concatenate(shares))) if shares else None


def rays(pixels: np.ndarray, camera: PhotoCamera) -> np.ndarray:
    """Camera coordinates [n, 2] at z = 1 of a photo's pixels [n, 2], centres at +0.5, distortion removed."""
    # OpenCV needs no shift here: pixels and principal point use the same origin.
    flat = cv2.undistortPoints(pixels.reshape(-1, 1, 2), camera.K, np.array(camera.distortion))
    return np.asarray(flat.reshape(-1, 2), dtype=np.float64)


def epipolar_error(pair: Pair, first: PhotoCamera, second: PhotoCamera) -> np.ndarray:
    """Sampson distance [m] in pixels (Hartley & Zisserman 2004, eq. 11.9) of a pair's matches."""
    relative = second.w2c @ np.linalg.inv(first.w2c)
    x, y, z = relative[:3, 3] / max(float(np.linalg.norm(relative[:3, 3])), 1e-12)
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ relative[:3, :3]
    one = np.pad(rays(pair.first_pixels, first), ((0, 0), (0, 1)), constant_values=1.0)
    two = np.pad(rays(pair.second_pixels, second), ((0, 0), (0, 1)), constant_values=1.0)
    line, back = one @ essential.T, two @ essential
    slope = np.sqrt(line[:, 0] ** 2 + line[:, 1] ** 2 + back[:, 0] ** 2 + back[:, 1] ** 2)
    focal = (first.focal[0] * second.focal[0]) ** 0.5
    return np.asarray(focal * np.abs((two * line).sum(1)) / np.maximum(slope, 1e-12))
