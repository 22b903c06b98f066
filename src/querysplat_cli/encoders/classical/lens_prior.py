"""What is known of a lens before its photos are looked at: its focal length, its middle and its distortion."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from querysplat_cli.encoders.classical.least_squares import LensPrior
from querysplat_cli.encoders.classical.policy import CAMERA_POLICY
from querysplat_cli.scene.cameras import PhotoCamera


@dataclass(frozen=True)
class ExpectedFocal:
    """A focal length in pixels before matches are looked at, and the standard deviation `spread` of its logarithm."""

    pixels: float
    spread: float


def lens_prior(
    sizes: Sequence[tuple[int, int]],
    stated: Sequence[float | None],
    expected: Sequence[ExpectedFocal],
    *,
    two_photos: bool = False,
) -> LensPrior:
    """The prior of lenses whose photos have these (height, width).

    Focal lengths: EXIF's in pixels or None, and the expected ones of the lenses without.
    """
    policy = CAMERA_POLICY
    weight = policy.prior_weight_two if two_photos else policy.prior_weight
    mean, sigma = [], []
    for (height, width), focal, assumed in zip(sizes, stated, expected, strict=True):
        longer = max(height, width)
        mean.append([np.log(focal or assumed.pixels), width / 2, height / 2, 0.0, 0.0])
        spread = policy.stated_focal_spread if focal else assumed.spread
        shift = policy.principal_spread * longer
        sigma.append([spread, shift, shift, *policy.distortion_spread])
    return LensPrior(np.array(mean), np.array(sigma), weight)


def usual_focal(height: int, width: int) -> ExpectedFocal:
    """The focal length that cameras and phones have, where EXIF states none.

    Sensors are 4:3 or longer. A photo that is nearer to a square was cut from one, so its focal length is measured in
    sides of that. Of a photo that the program cut, the (height, width) of the whole is to be given.
    """
    pixels = CAMERA_POLICY.usual_focal * max(height, width, 4 / 3 * min(height, width))
    return ExpectedFocal(pixels, CAMERA_POLICY.usual_focal_spread)


def as_photo_camera(pose: np.ndarray, lens: np.ndarray, size: tuple[int, int]) -> PhotoCamera:
    """The camera of a pose [3, 4] and lens parameters [5] for a photo of this (height, width)."""
    logarithm, x, y, k1, k2 = (float(value) for value in lens)
    w2c = np.eye(4)
    w2c[:3] = pose
    focal = float(np.exp(logarithm))
    return PhotoCamera(w2c, (focal, focal), (x, y), (k1, k2, 0.0, 0.0), *size)
