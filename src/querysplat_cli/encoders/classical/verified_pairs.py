"""Pairs of photos in COLMAP's database: matched, verified by a two-view geometry, and read as arrays of pixels."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from querysplat_cli.encoders.classical.features import image_name
from querysplat_cli.encoders.classical.policy import CAMERA_POLICY, MatchEffort

UNRELATED = {
    pycolmap.TwoViewGeometryConfiguration.UNDEFINED,
    pycolmap.TwoViewGeometryConfiguration.DEGENERATE,
    pycolmap.TwoViewGeometryConfiguration.WATERMARK,
}

PAIR_BLOCK = 50
"""Pairs of one call of COLMAP. Ctrl-C waits for it."""


@dataclass(frozen=True)
class Pair:
    """Photos `first` < `second` with the pixels [m, 2] that a common two-view geometry explains."""

    first: int
    second: int
    first_pixels: np.ndarray
    second_pixels: np.ndarray

    @property
    def ends(self) -> tuple[int, int]:
        """The numbers of both photos, the smaller one first."""
        return self.first, self.second

    def __len__(self) -> int:
        return len(self.first_pixels)


@dataclass(frozen=True)
class Verification:
    """How two-view geometries are found.

    A pair needs `fewest_inliers` within `tolerance` pixels. With `calibrated` True, the essential matrix under the
    prior focal length explains the matches, or a homography does. Otherwise it may also be a fundamental matrix, which
    explains more wrong matches.
    """

    seed: int
    fewest_inliers: int
    tolerance: float
    calibrated: bool

    @staticmethod
    def of(sizes: Sequence[tuple[int, int]], effort: MatchEffort, seed: int) -> "Verification":
        """That of so many photos: a few do not determine their lens, so its prior is taken."""
        policy = CAMERA_POLICY
        calibrated = len(sizes) <= policy.few_photos
        tolerance = policy.calibrated_tolerance * max(map(max, sizes)) if calibrated else policy.epipolar_tolerance
        return Verification(seed, effort.fewest_inliers, tolerance, calibrated)

    def options(self) -> pycolmap.TwoViewGeometryOptions:
        options = pycolmap.TwoViewGeometryOptions()
        options.ransac.random_seed = self.seed
        options.min_num_inliers = self.fewest_inliers
        options.ransac.max_error = self.tolerance
        if self.calibrated:
            options.min_E_F_inlier_ratio = 0.0
        return options


def match_pairs(
    database: Path,
    folder: Path,
    pairs: Sequence[tuple[int, int]],
    effort: MatchEffort,
    verification: Verification | None,
    done: Callable[[float], None] = lambda share: None,
) -> None:
    """Match the features of these pairs of photos; without `verification`, matches are kept as they are found.

    One block of pairs after the other, never two at once: see `matching_options`. `done` is told the share of the
    pairs that are matched.
    """
    matching = matching_options(effort)
    matching.skip_geometric_verification = verification is None
    options = verification.options() if verification else pycolmap.TwoViewGeometryOptions()
    pairing = pycolmap.ImportedPairingOptions()
    for start in range(0, len(pairs), PAIR_BLOCK):
        block = pairs[start : start + PAIR_BLOCK]
        pairing.match_list_path = _listing(folder / "pairs.txt", block)
        pycolmap.match_image_pairs(
            database, matching_options=matching, pairing_options=pairing, verification_options=options
        )
        done((start + len(block)) / len(pairs))


def matching_options(effort: MatchEffort) -> pycolmap.FeatureMatchingOptions:
    """How features are matched, on one thread.

    The OpenBLAS inside the wheels of pycolmap is built for one thread and takes no lock. Where two threads match at
    once, COLMAP's own or ours, a pair loses some or all of its matches now and then. Verification, which needs no
    BLAS, has its own thread beside.
    """
    options = pycolmap.FeatureMatchingOptions()
    options.use_gpu = False
    options.num_threads = 1
    options.sift.max_ratio = effort.match_ratio
    return options


def verify_pairs(database: Path, folder: Path, pairs: Iterable[tuple[int, int]], verification: Verification) -> None:
    """Find a two-view geometry for the matches of these pairs of photos, which must have none yet."""
    listing = _listing(folder / "pairs.txt", pairs)
    pycolmap.verify_matches(database, listing, options=verification.options())


def matched_rows(store: pycolmap.Database, first: int, second: int) -> np.ndarray:
    """Rows [m, 2] of the features of two photos in the database that match, right and wrong ones."""
    numbers = first + 1, second + 1
    return np.asarray(store.read_matches(*numbers) if store.exists_matches(*numbers) else np.zeros((0, 2), np.uint32))


def read_candidates(store: pycolmap.Database, first: int, second: int) -> Pair:
    """All matches of two photos in the database, right and wrong ones."""
    rows = matched_rows(store, first, second)
    sides = [store.read_keypoints(photo + 1)[:, :2].astype(np.float64) for photo in (first, second)]
    return Pair(first, second, sides[0][rows[:, 0]], sides[1][rows[:, 1]])


def read_pairs(store: pycolmap.Database, photos: int) -> tuple[Pair, ...]:
    """The verified pairs of the database, in the order of their photos' numbers."""
    keypoints = [store.read_keypoints(photo + 1)[:, :2].astype(np.float64) for photo in range(photos)]
    pairs = []
    for pair_id, geometry in zip(*store.read_two_view_geometries(), strict=True):
        matches = geometry.inlier_matches
        if geometry.config in UNRELATED or not len(matches):
            continue
        one, two = (number - 1 for number in pycolmap.pair_id_to_image_pair(pair_id))
        pixels = {one: keypoints[one][matches[:, 0]], two: keypoints[two][matches[:, 1]]}
        first, second = min(one, two), max(one, two)
        pairs.append(Pair(first, second, pixels[first], pixels[second]))
    return tuple(sorted(pairs, key=lambda pair: pair.ends))


def connected_groups(ends: Sequence[tuple[int, int]], photos: int) -> np.ndarray:
    """The number of each photo's group [photos]: pairs with these ends connect them, directly or not."""
    first, second = np.array(ends, np.int64).reshape(-1, 2).T
    _, group = connected_components(coo_array((np.ones(len(ends)), (first, second)), shape=(photos, photos)))
    return np.asarray(group)


def _listing(path: Path, pairs: Iterable[tuple[int, int]]) -> Path:
    path.write_text("".join(f"{image_name(first)} {image_name(second)}\n" for first, second in pairs))
    return path
