"""SIFT matches of a few photos that their neighbours support, for photos that the usual search matches badly.

Between photos from places far apart, most right matches do not stand out by the ratio test. But their neighbours are
right, too. An affine feature has a shape in both photos, and both shapes together say how the picture around it is
mapped from one photo to the other. Where that map puts the neighbouring features near their own partners, the match is
kept at any ratio. Wrong matches agree with their neighbours by chance only (AdaLAM, Cavalli et al., ECCV 2020).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import pycolmap
import torch
from scipy.spatial import cKDTree

from querysplat_cli.encoders.classical.append_matches import append_features, append_matches
from querysplat_cli.encoders.classical.features import extract_features, write_grey, write_masks
from querysplat_cli.encoders.classical.matches import Matches, shared_cameras, write_images
from querysplat_cli.encoders.classical.policy import CAMERA_POLICY
from querysplat_cli.encoders.classical.verified_pairs import Verification, read_pairs, verify_pairs
from querysplat_cli.scene.lenses import same_panorama
from querysplat_cli.scene.views import Photo

NEAREST_COMPARED = 8
"""Among so many nearest features, the second nearest is looked for that stands elsewhere."""


@dataclass(frozen=True)
class ShapedFeatures:
    """Features of a picture of `size` (height, width).

    Pixels [n, 2] with centres at +0.5, shapes [n, 2, 2] that map the unit circle to the features, and unit descriptors
    [n, d].
    """

    size: tuple[int, int]
    pixels: np.ndarray
    shapes: np.ndarray
    descriptors: np.ndarray

    def scaled(self, size: tuple[int, int]) -> np.ndarray:
        """The pixels [n, 2] in a picture of another (height, width)."""
        return np.asarray(self.pixels * [size[1] / self.size[1], size[0] / self.size[0]])


@dataclass(frozen=True)
class Candidates:
    """Matches of two photos: rows [m, 2] of their features, pixels [m, 2] in each, and ratios [m] of distances.

    `maps` [m, 2, 2] take steps in the first photo to steps in the second.
    """

    rows: np.ndarray
    one: np.ndarray
    two: np.ndarray
    maps: np.ndarray
    ratios: np.ndarray

    def __getitem__(self, kept: np.ndarray) -> "Candidates":
        return Candidates(self.rows[kept], self.one[kept], self.two[kept], self.maps[kept], self.ratios[kept])


def with_supported_matches(matches: Matches, photos: Sequence[Photo], *, seed: int) -> Matches:
    """The matches, and supported ones for every pair of photos in place of those that each pair has.

    The features are appended to those of their photos in COLMAP's database.
    """
    found = _features(matches, photos)
    pairs = [pair for pair in combinations(range(len(photos)), 2) if not same_panorama(*(photos[i] for i in pair))]
    rows = {(one, two): supported_rows(found[one], found[two]) for one, two in pairs}
    enough = {pair: some for pair, some in rows.items() if len(some) >= CAMERA_POLICY.supported.fewest_inliers}
    with pycolmap.Database.open(matches.database) as store:
        first_new = [store.num_keypoints_for_image(photo + 1) for photo in range(len(photos))]
        append_features(store, {photo: some.scaled(matches.sizes[photo]) for photo, some in enumerate(found)})
        for one, two in enough:
            if store.exists_matches(one + 1, two + 1):
                store.delete_matches(one + 1, two + 1)
        moved = {(one, two): some + np.array([first_new[one], first_new[two]]) for (one, two), some in enough.items()}
        changed = append_matches(store, moved)
    verification = Verification.of(matches.sizes, CAMERA_POLICY.supported, seed)
    verify_pairs(matches.database, matches.folder, changed, verification)
    with pycolmap.Database.open(matches.database) as store:
        return replace(matches, pairs=read_pairs(store, len(photos)))


def supported_rows(first: ShapedFeatures, second: ShapedFeatures) -> np.ndarray:
    """Rows [m, 2] of the features of two photos that match, each supported by neighbours, best first."""
    if min(len(first.pixels), len(second.pixels)) < 2:
        return np.zeros((0, 2), np.int64)
    candidates = _distinct(nearest_matches(first, second))
    support = _support(candidates, CAMERA_POLICY.support_reach * max(first.size))
    return candidates[support >= CAMERA_POLICY.supporting_matches].rows


def nearest_matches(first: ShapedFeatures, second: ShapedFeatures) -> Candidates:
    """Features of two photos that are the nearest of each other, at any ratio."""
    cosines = torch.from_numpy(first.descriptors) @ torch.from_numpy(second.descriptors).T
    forth, ratios = _nearest(cosines, second.pixels)
    back, ratios_back = _nearest(cosines.T, first.pixels)
    one = np.flatnonzero(back[forth] == np.arange(len(forth)))
    two = forth[one]
    maps = second.shapes[two] @ np.linalg.inv(first.shapes[one])
    worse = np.maximum(ratios[one], ratios_back[two])
    return Candidates(np.column_stack([one, two]), first.pixels[one], second.pixels[two], maps, worse)


def _nearest(cosines: torch.Tensor, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The nearest column of each row, and its angle divided by that of the nearest one that stands elsewhere."""
    best, columns = torch.topk(cosines, min(NEAREST_COMPARED, cosines.shape[1]), dim=1)
    angles, order = np.arccos(np.clip(best.numpy(), -1, 1)), columns.numpy()
    apart = np.linalg.norm(pixels[order] - pixels[order[:, :1]], axis=2) > CAMERA_POLICY.same_place
    second = np.where(apart, angles, angles[:, -1:]).min(1)
    return order[:, 0], angles[:, 0] / np.maximum(second, 1e-9)


def _distinct(candidates: Candidates) -> Candidates:
    """The candidates of lowest ratio, without those that stand where a better one does in either photo."""
    order = np.argsort(candidates.ratios, kind="stable")
    sides = candidates.one[order], candidates.two[order]
    close = [cKDTree(side).query_pairs(CAMERA_POLICY.same_place, output_type="ndarray") for side in sides]
    better, worse = np.concatenate(close).T
    dropped = np.zeros(len(order), bool)
    for place in np.argsort(better, kind="stable"):
        if not dropped[better[place]]:
            dropped[worse[place]] = True
    return candidates[order[~dropped]]


def _support(candidates: Candidates, reach: float) -> np.ndarray:
    """How many neighbours within `reach` pixels agree with each candidate [m].

    Two candidates agree where the map of each puts the other one near its partner, and the maps are alike.
    """
    policy = CAMERA_POLICY
    near = cKDTree(candidates.one).query_pairs(reach, output_type="ndarray")
    agree = np.ones(len(near), bool)
    for one, two in (near.T, near.T[::-1]):
        step = candidates.one[two] - candidates.one[one]
        expected = np.einsum("nij,nj->ni", candidates.maps[one], step)
        real = candidates.two[two] - candidates.two[one]
        size = np.maximum(np.linalg.norm(expected, axis=1), np.linalg.norm(real, axis=1))
        allowed = policy.same_place + policy.support_tolerance * size
        agree &= np.linalg.norm(expected - real, axis=1) < allowed
        change = np.linalg.norm(candidates.maps[two] - candidates.maps[one], axis=(1, 2))
        agree &= change < policy.map_tolerance * np.linalg.norm(candidates.maps[one], axis=(1, 2))
    return np.bincount(near[agree].ravel(), minlength=len(candidates.rows))


def _features(matches: Matches, photos: Sequence[Photo]) -> list[ShapedFeatures]:
    """Affine features of the photos."""
    effort, folder = CAMERA_POLICY.supported, matches.folder / "supported"
    folder.mkdir()
    sizes = write_grey(photos, folder, effort.feature_size)
    write_masks(photos, sizes, folder)
    database = folder / "matches.db"
    with pycolmap.Database.open(database) as store:
        write_images(store, shared_cameras(sizes, [None] * len(sizes)))
    extract_features(database, folder, effort)
    with pycolmap.Database.open(database) as store:
        return [_shaped(store, photo, size) for photo, size in enumerate(sizes)]


def _shaped(store: pycolmap.Database, photo: int, size: tuple[int, int]) -> ShapedFeatures:
    keypoints = store.read_keypoints(photo + 1).astype(np.float64)
    descriptors = store.read_descriptors(photo + 1).data.astype(np.float32)
    lengths = np.maximum(np.linalg.norm(descriptors, axis=1, keepdims=True), 1e-9)
    return ShapedFeatures(size, keypoints[:, :2], keypoints[:, 2:6].reshape(-1, 2, 2), descriptors / lengths)
