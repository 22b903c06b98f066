"""What is known of a lens before its photos are looked at: its focal length, its middle and its distortion."""

from collections.abc import Sequence

import numpy as np

from querysplat_cli.encoders.classical.least_squares import LensPrior
from querysplat_cli.encoders.classical.policy import CAMERA_POLICY
from querysplat_cli.scene.cameras import PhotoCamera


def lens_prior(
    sizes: Sequence[tuple[int, int]],
    stated: Sequence[float | None],
    usual: Sequence[float],
    *,
    two_photos: bool = False,
) -> LensPrior:
    """The prior of lenses whose photos have these (height, width).

    Focal lengths in pixels: EXIF's or None, and `usual_focal` for the lenses without.
    """
    policy = CAMERA_POLICY
    weight = policy.prior_weight_two if two_photos else policy.prior_weight
    mean, sigma = [], []
    for (height, width), focal, assumed in zip(sizes, stated, usual, strict=True):
        longer = max(height, width)
        mean.append([np.log(focal or assumed), width / 2, height / 2, 0.0, 0.0])
        spread = policy.stated_focal_spread if focal else policy.usual_focal_spread
        shift = policy.principal_spread * longer
        sigma.append([spread, shift, shift, *policy.distortion_spread])
    return LensPrior(np.array(mean), np.array(sigma), weight)


def usual_focal(height: int, width: int) -> float:
    """The prior's focal length in pixels, where EXIF states none.

    Sensors are 4:3 or longer. A photo that is nearer to a square was cut from one, so its focal length is measured in
    sides of that. Of a photo that the program cut, the (height, width) of the whole is to be given.
    """
    return CAMERA_POLICY.usual_focal * max(height, width, 4 / 3 * min(height, width))


def as_photo_camera(pose: np.ndarray, lens: np.ndarray, size: tuple[int, int]) -> PhotoCamera:
    """The camera of a pose [3, 4] and lens parameters [5] for a photo of this (height, width)."""
    logarithm, x, y, k1, k2 = (float(value) for value in lens)
    w2c = np.eye(4)
    w2c[:3] = pose
    focal = float(np.exp(logarithm))
    return PhotoCamera(w2c, (focal, focal), (x, y), (k1, k2, 0.0, 0.0), *size)
