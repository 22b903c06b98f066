"""SIFT matches of a few photos that their neighbours support, for photos that the usual search matches badly.

Between photos from places far apart, most right matches do not stand out by the ratio test. But their neighbours are
right, too. An affine feature has a shape in both photos, and both shapes together say how the picture around it is
mapped from one photo to the other. Where that map puts the neighbouring features near their own partners, the match is
kept at any ratio. Wrong matches agree with their neighbours by chance only (AdaLAM, Cavalli et al., ECCV 2020).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pycolmap
import torch
from scipy.spatial import cKDTree

from querysplat_cli.encoders.classical.append_matches import append_features, replace_matches
from querysplat_cli.encoders.classical.features import extract_features, write_grey, write_masks
from querysplat_cli.encoders.classical.matches import Matches, shared_cameras, write_images
from querysplat_cli.encoders.classical.policy import MatchEffort
from querysplat_cli.encoders.classical.support_policy import SUPPORT_POLICY
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
    """The matches, with supported ones instead for every pair of photos that has enough of those.

    The features are appended to those of their photos in COLMAP's database.
    """
    found = _features(matches, photos)
    pairs = [pair for pair in combinations(range(len(photos)), 2) if not same_panorama(*(photos[i] for i in pair))]
    rows = {(one, two): supported_rows(found[one], found[two]) for one, two in pairs}
    enough = {pair: some for pair, some in rows.items() if len(some) >= SUPPORT_POLICY.effort.fewest_inliers}
    with pycolmap.Database.open(matches.database) as store:
        first_new = [store.num_keypoints_for_image(photo + 1) for photo in range(len(photos))]
        append_features(store, {photo: some.scaled(matches.sizes[photo]) for photo, some in enumerate(found)})
        moved = {(one, two): some + np.array([first_new[one], first_new[two]]) for (one, two), some in enough.items()}
        changed = replace_matches(store, moved)
    return matches.verified_again(changed, SUPPORT_POLICY.effort, seed)


def supported_rows(first: ShapedFeatures, second: ShapedFeatures) -> np.ndarray:
    """Rows [m, 2] of the features of two photos that match, each supported by neighbours.

    Around the matches that are found so, more are looked for where the maps of these expect them. No rows are returned
    where hardly any match with support stands out by its ratio, too: such support may be chance, and would grow.
    """
    if min(len(first.pixels), len(second.pixels)) < 2:
        return np.zeros((0, 2), np.int64)
    policy, reach = SUPPORT_POLICY, SUPPORT_POLICY.reach * max(first.size)
    nearest = _distinct(nearest_matches(first, second))
    found = nearest[_support(nearest, reach) >= policy.neighbours]
    if np.count_nonzero(found.ratios < policy.distinct_ratio) < policy.distinct_matches:
        return np.zeros((0, 2), np.int64)
    more = _distinct(_joined(found, _grown(first, second, found, reach)))
    return more[_support(more, reach) >= policy.neighbours_grown].rows


def nearest_matches(first: ShapedFeatures, second: ShapedFeatures) -> Candidates:
    """Features of two photos that are the nearest of each other, at any ratio."""
    cosines = torch.from_numpy(first.descriptors) @ torch.from_numpy(second.descriptors).T
    forth, ratios = _nearest(cosines, second.pixels)
    back, ratios_back = _nearest(cosines.T, first.pixels)
    one = np.flatnonzero(back[forth] == np.arange(len(forth)))
    two = forth[one]
    return _candidates(first, second, np.column_stack([one, two]), np.maximum(ratios[one], ratios_back[two]))


def _candidates(first: ShapedFeatures, second: ShapedFeatures, rows: np.ndarray, ratios: np.ndarray) -> Candidates:
    one, two = rows.T
    maps = second.shapes[two] @ np.linalg.inv(first.shapes[one])
    return Candidates(rows, first.pixels[one], second.pixels[two], maps, ratios)


def _joined(better: Candidates, worse: Candidates) -> Candidates:
    """Both, the ratios of the latter raised above those of the former."""
    worse = replace(worse, ratios=worse.ratios + better.ratios.max(initial=0))
    names = ("rows", "one", "two", "maps", "ratios")
    return Candidates(*(np.concatenate([getattr(better, name), getattr(worse, name)]) for name in names))


def _grown(first: ShapedFeatures, second: ShapedFeatures, anchors: Candidates, reach: float) -> Candidates:
    """Features of two photos that are the best for each other where the maps of near anchors expect them."""
    pairs = _expected_pairs(first, second, anchors, reach)
    cosines = np.einsum("nd,nd->n", first.descriptors[pairs[:, 0]], second.descriptors[pairs[:, 1]])
    angles = np.arccos(np.clip(cosines, -1, 1))
    order = np.lexsort((angles, pairs[:, 0]))
    pairs, angles = pairs[order], angles[order]
    best = np.unique(pairs[:, 0], return_index=True)[1]
    if not len(best):
        return _candidates(first, second, pairs, angles)
    winner = best[np.searchsorted(pairs[best, 0], pairs[:, 0])]
    apart = second.pixels[pairs[:, 1]] - second.pixels[pairs[winner, 1]]
    elsewhere = np.where(np.linalg.norm(apart, axis=1) > SUPPORT_POLICY.same_place, angles, np.pi)
    ratios = angles[best] / np.maximum(np.minimum.reduceat(elsewhere, best), 1e-9)
    back = np.full(len(second.pixels), np.inf)
    np.minimum.at(back, pairs[:, 1], angles)
    mutual = angles[best] <= back[pairs[best, 1]]
    kept = mutual & (angles[best] < SUPPORT_POLICY.grown_angle) & (ratios < SUPPORT_POLICY.grown_ratio)
    return _candidates(first, second, pairs[best[kept]], angles[best[kept]])


def _expected_pairs(first: ShapedFeatures, second: ShapedFeatures, anchors: Candidates, reach: float) -> np.ndarray:
    """Rows [n, 2] of features whose places and shapes are about those that the map of a near anchor expects."""
    policy = SUPPORT_POLICY
    count = min(policy.anchors, len(anchors.rows))
    distance, nearest = cKDTree(anchors.one).query(first.pixels, k=range(1, count + 1), distance_upper_bound=reach)
    feature, slot = np.nonzero(np.isfinite(distance))
    anchor = nearest[feature, slot]
    step = np.einsum("nij,nj->ni", anchors.maps[anchor], first.pixels[feature] - anchors.one[anchor])
    allowed = 2 * policy.same_place + policy.tolerance * np.linalg.norm(step, axis=1)
    hits = cKDTree(second.pixels).query_ball_point(anchors.two[anchor] + step, allowed, return_sorted=True)
    repeats = np.repeat(np.arange(len(hits)), [len(some) for some in hits])
    other = np.fromiter((row for some in hits for row in some), np.int64, len(repeats))
    feature, anchor = feature[repeats], anchor[repeats]
    shape = anchors.maps[anchor] @ first.shapes[feature]
    change = np.linalg.norm(second.shapes[other] - shape, axis=(1, 2))
    alike = change < policy.grown_alike * np.linalg.norm(shape, axis=(1, 2))
    return np.unique(np.column_stack([feature, other])[alike], axis=0)


def _nearest(cosines: torch.Tensor, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The nearest column of each row, and its angle divided by that of the nearest one that stands elsewhere."""
    best, columns = torch.topk(cosines, min(NEAREST_COMPARED, cosines.shape[1]), dim=1)
    angles, order = np.arccos(np.clip(best.numpy(), -1, 1)), columns.numpy()
    apart = np.linalg.norm(pixels[order] - pixels[order[:, :1]], axis=2) > SUPPORT_POLICY.same_place
    second = np.where(apart, angles, angles[:, -1:]).min(1)
    return order[:, 0], angles[:, 0] / np.maximum(second, 1e-9)


def _distinct(candidates: Candidates) -> Candidates:
    """The candidates of lowest ratio, without those that stand where a better one does in either photo."""
    order = np.argsort(candidates.ratios, kind="stable")
    sides = candidates.one[order], candidates.two[order]
    close = [cKDTree(side).query_pairs(SUPPORT_POLICY.same_place, output_type="ndarray") for side in sides]
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
    policy = SUPPORT_POLICY
    near = cKDTree(candidates.one).query_pairs(reach, output_type="ndarray")
    agree = np.ones(len(near), bool)
    for one, two in (near.T, near.T[::-1]):
        step = candidates.one[two] - candidates.one[one]
        expected = np.einsum("nij,nj->ni", candidates.maps[one], step)
        real = candidates.two[two] - candidates.two[one]
        size = np.maximum(np.linalg.norm(expected, axis=1), np.linalg.norm(real, axis=1))
        allowed = policy.same_place + policy.tolerance * size
        agree &= np.linalg.norm(expected - real, axis=1) < allowed
        change = np.linalg.norm(candidates.maps[two] - candidates.maps[one], axis=(1, 2))
        agree &= change < policy.alike * np.linalg.norm(candidates.maps[one], axis=(1, 2))
    return np.bincount(near[agree].ravel(), minlength=len(candidates.rows))


def _features(matches: Matches, photos: Sequence[Photo]) -> list[ShapedFeatures]:
    """Affine and round features of the photos."""
    folder = matches.folder / "supported"
    folder.mkdir()
    sizes = write_grey(photos, folder, SUPPORT_POLICY.effort.feature_size)
    write_masks(photos, sizes, folder)
    kinds = [_searched(folder, sizes, replace(SUPPORT_POLICY.effort, affine=affine)) for affine in (True, False)]
    return [_both(*some) for some in zip(*kinds, strict=True)]


def _searched(folder: Path, sizes: Sequence[tuple[int, int]], effort: MatchEffort) -> list[ShapedFeatures]:
    database = folder / f"affine-{effort.affine}.db"
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


def _both(one: ShapedFeatures, two: ShapedFeatures) -> ShapedFeatures:
    names = ("pixels", "shapes", "descriptors")
    return ShapedFeatures(one.size, *(np.concatenate([getattr(one, name), getattr(two, name)]) for name in names))
