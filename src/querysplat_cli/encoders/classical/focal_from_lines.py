"""The focal lengths to be expected of photos without EXIF: those that are usual, and of a few photos what lines tell.

Two to four photos hardly determine a focal length by their matches, and a wrong one turns the cameras. Straight lines
in each photo alone determine it where they belong to rooms, buildings, streets or furniture.
"""

from collections.abc import Sequence

import cv2
import numpy as np

from querysplat_cli.encoders.classical.lens_prior import ExpectedFocal, usual_focal
from querysplat_cli.encoders.classical.lines_policy import LINES_POLICY
from querysplat_cli.encoders.classical.manhattan import focal_evidence, straight_lines
from querysplat_cli.encoders.classical.policy import CAMERA_POLICY
from querysplat_cli.scene.filed_pixels import release
from querysplat_cli.scene.views import Photo


def usual_focals(photos: Sequence[Photo], sizes: Sequence[tuple[int, int]]) -> tuple[ExpectedFocal, ...]:
    """The usual focal length of each photo, in pixels of its (height, width) in `sizes`."""
    found = []
    for photo, (_, width) in zip(photos, sizes, strict=True):
        whole = usual_focal(*(photo.cut_from or (photo.height, photo.width)))
        found.append(ExpectedFocal(whole.pixels * width / photo.width, whole.spread))
    return tuple(found)


def expected_focals(
    photos: Sequence[Photo], sizes: Sequence[tuple[int, int]], *, seed: int
) -> tuple[ExpectedFocal, ...]:
    """The usual focal lengths, or of a few photos without EXIF those that their lines tell.

    Photos of one size have one lens. Pixels are those of the photos at their (height, width) in `sizes`.
    """
    expected = list(usual_focals(photos, sizes))
    if len(photos) > CAMERA_POLICY.few_photos:
        return tuple(expected)
    lenses: dict[tuple[tuple[int, int], ExpectedFocal], list[int]] = {}
    for place, photo in enumerate(photos):
        if not photo.focal:
            lenses.setdefault((sizes[place], expected[place]), []).append(place)
    for (size, usual), places in lenses.items():
        tried = tried_focals(usual)
        evidence = [_evidence(photos[place], tried / max(size), seed) for place in places]
        for place in places:
            expected[place] = combined(usual, tried, evidence)
    return tuple(expected)


def told_by_lines(expected: ExpectedFocal) -> bool:
    """Whether the lines of the photo determine its focal length."""
    return expected.spread < LINES_POLICY.told_spread


def tried_focals(usual: ExpectedFocal) -> np.ndarray:
    """Focal lengths [f] around the usual one, in pixels."""
    reach = LINES_POLICY.reach * usual.spread
    return usual.pixels * np.exp(np.linspace(-reach, reach, LINES_POLICY.focals))


def combined(usual: ExpectedFocal, tried: np.ndarray, evidence: Sequence[np.ndarray]) -> ExpectedFocal:
    """What lines make of the usual focal length, or the same where they do not tell one.

    It is the mean of the usual distribution times the likelihood of the `tried` focal lengths [f], in pixels.
    `evidence` has the logarithms [f] of that likelihood for each photo. Their mean counts: photos of one place share
    what is not at right angles there.
    """
    logarithms = np.log(tried)
    chances = np.mean(evidence, axis=0) - 0.5 * ((logarithms - np.log(usual.pixels)) / usual.spread) ** 2
    weights = np.exp(chances - chances.max())
    weights /= weights.sum()
    mean = float(weights @ logarithms)
    spread = float(np.sqrt(weights @ (logarithms - mean) ** 2))
    found = ExpectedFocal(float(np.exp(mean)), float(np.hypot(spread, LINES_POLICY.least_spread)))
    return found if told_by_lines(found) else usual


def _evidence(photo: Photo, tried: np.ndarray, seed: int) -> np.ndarray:
    lines = straight_lines(cv2.cvtColor(photo.pixels, cv2.COLOR_RGB2GRAY), photo.mask)
    release(photo)
    return focal_evidence(lines, tried, seed=seed)
