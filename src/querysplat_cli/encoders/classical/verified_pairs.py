"""Pairs of photos in COLMAP's database: matched, verified by a two-view geometry, and read as arrays of pixels."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from querysplat_cli.encoders.classical.features import image_name
from querysplat_cli.encoders.classical.policy import MatchEffort

UNRELATED = {
    pycolmap.TwoViewGeometryConfiguration.UNDEFINED,
    pycolmap.TwoViewGeometryConfiguration.DEGENERATE,
    pycolmap.TwoViewGeometryConfiguration.WATERMARK,
}


@dataclass(frozen=True)
class Pair:
    """Photos `first` < `second` with the pixels [m, 2] that a common two-view geometry explains."""

    first: int
    second: int
    first_pixels: np.ndarray
    second_pixels: np.ndarray

    def __len__(self) -> int:
        return len(self.first_pixels)


def match_pairs(
    database: Path,
    folder: Path,
    pairs: Iterable[tuple[int, int]],
    seed: int,
    effort: MatchEffort,
    *,
    verify: bool = True,
) -> None:
    """Match the features of these pairs of photos. With `verify` False, matches are kept as they are found."""
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = _listing(folder, pairs)
    # COLMAP notices Ctrl-C between blocks only.
    pairing.block_size = 100
    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu = False
    matching.guided_matching = effort.guided
    matching.sift.max_ratio = effort.match_ratio
    matching.skip_geometric_verification = not verify
    pycolmap.match_image_pairs(
        database,
        matching_options=matching,
        pairing_options=pairing,
        verification_options=_verification(seed, effort),
    )


def verify_pairs(
    database: Path, folder: Path, pairs: Iterable[tuple[int, int]], seed: int, effort: MatchEffort
) -> None:
    """Find a two-view geometry for the matches of these pairs of photos, which must have none yet."""
    pycolmap.verify_matches(database, _listing(folder, pairs), options=_verification(seed, effort))


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
    return tuple(sorted(pairs, key=lambda pair: (pair.first, pair.second)))


def _listing(folder: Path, pairs: Iterable[tuple[int, int]]) -> Path:
    listing = folder / "pairs.txt"
    listing.write_text("".join(f"{image_name(first)} {image_name(second)}\n" for first, second in pairs))
    return listing


def _verification(seed: int, effort: MatchEffort) -> pycolmap.TwoViewGeometryOptions:
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    verification.min_num_inliers = effort.fewest_inliers
    return verification
