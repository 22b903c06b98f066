"""Matches of a few photos that rest though the camera moved: those of text, logos and frames over the photos."""

from itertools import combinations

import cv2
import numpy as np
import pycolmap

from querysplat_cli.encoders.classical.append_matches import replace_matches
from querysplat_cli.encoders.classical.matches import Matches
from querysplat_cli.encoders.classical.policy import CAMERA_POLICY
from querysplat_cli.encoders.classical.verified_pairs import matched_rows, read_candidates


def without_resting_matches(matches: Matches, *, seed: int) -> Matches:
    """The matches of a few photos, without those that rest where the others of their pair say that the camera moved.

    COLMAP's database follows.
    """
    if not matches.few:
        return matches
    kept = {}
    with pycolmap.Database.open(matches.database) as store:
        for one, two in combinations(range(len(matches.sizes)), 2):
            if matches.sizes[one] != matches.sizes[two]:
                continue
            pair = read_candidates(store, one, two)
            resting = resting_matches(pair.first_pixels, pair.second_pixels, matches.sizes[one])
            if resting.any():
                kept[one, two] = matched_rows(store, one, two)[~resting]
        changed = replace_matches(store, kept)
    return matches.verified_again(changed, CAMERA_POLICY.ordinary, seed) if changed else matches


def resting_matches(first: np.ndarray, second: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Which matches [n], of pixels [n, 2] in two photos of this size (height, width), rest though the camera moved.

    None do where the others, as far as one epipolar geometry explains them, are few, moved little, or cover much less
    of the photo, as those of a car before a resting camera do.
    """
    policy = CAMERA_POLICY
    shift = np.linalg.norm(first - second, axis=1)
    resting = shift < policy.resting
    nothing = np.zeros_like(resting)
    if not resting.any() or np.count_nonzero(~resting) < policy.fewest_two_view_points:
        return nothing
    one, two = first[~resting], second[~resting]
    _, inside = cv2.findFundamentalMat(one, two, cv2.FM_RANSAC, policy.resting_tolerance, 0.9999, 10_000)
    good = nothing[~resting] if inside is None else inside[:, 0] > 0
    if good.sum() < policy.fewest_two_view_points or np.median(shift[~resting][good]) < policy.moving * max(size):
        return nothing
    wide = _cells(one[good], size) >= policy.moving_cover * _cells(first[resting], size)
    return resting if wide else nothing


def _cells(pixels: np.ndarray, size: tuple[int, int]) -> int:
    """How many cells of a grid over the photo hold a pixel."""
    height, width = size
    cells = (pixels / [width, height] * CAMERA_POLICY.spread_cells).astype(np.int64)
    return len(np.unique(cells, axis=0))
