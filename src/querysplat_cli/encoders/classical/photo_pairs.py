"""Which pairs of photos are matched: all of a few; of many, similar photos, neighbours, and frames near in a film."""

import warnings
from collections.abc import Iterator, Sequence

import numpy as np
import pycolmap
from scipy.cluster.vq import kmeans2, vq

from querysplat_cli.encoders.classical.features import feature_sizes
from querysplat_cli.encoders.classical.policy import CAMERA_POLICY
from querysplat_cli.scene.lenses import same_panorama
from querysplat_cli.scene.views import Photo


def choose_pairs(store: pycolmap.Database, photos: Sequence[Photo]) -> list[tuple[int, int]]:
    """Pairs of photo numbers, the smaller one first, in order. The database has the features of all photos."""
    count, policy = len(photos), CAMERA_POLICY
    if count <= policy.exhaustive_photos:
        chosen = {(i, j) for i in range(count) for j in range(i + 1, count)}
    else:
        chosen = set(_similar([_largest_features(store, photo) for photo in range(count)]))
        chosen |= {(i, i + step) for step in policy.neighbour_steps for i in range(count - step)}
        apart = [(i, i + step) for step in policy.film_steps for i in range(count - step)]
        chosen |= {(i, j) for i, j in apart if _of_one_film(photos[i], photos[j])}
    return sorted((i, j) for i, j in chosen if not same_panorama(photos[i], photos[j]))


def _of_one_film(one: Photo, other: Photo) -> bool:
    return one.pts is not None and one.path == other.path


def _largest_features(store: pycolmap.Database, photo: int) -> np.ndarray:
    """Unit descriptors [n, 128] of a photo's largest features."""
    keypoints = store.read_keypoints(photo + 1)
    largest = np.argsort(-feature_sizes(keypoints), kind="stable")[: CAMERA_POLICY.compared_features]
    descriptors = store.read_descriptors(photo + 1).data[largest].astype(np.float32)
    return np.asarray(descriptors / np.maximum(np.linalg.norm(descriptors, axis=1, keepdims=True), 1))


def _similar(descriptors: Sequence[np.ndarray]) -> Iterator[tuple[int, int]]:
    """Each photo with those that have most features in common with it, the smaller number first."""
    near = resembling(descriptors)
    common = np.zeros(near.shape, np.int16)
    for photo, others in enumerate(near):
        numbers = np.flatnonzero(others)
        common[photo, numbers] = _common_features(
            descriptors[photo], [descriptors[other] for other in numbers.tolist()]
        )
    for photo in range(len(common)):
        order = np.argsort(-(common[photo] + common[:, photo]), kind="stable")
        yield from ((min(photo, i), max(photo, i)) for i in order[: CAMERA_POLICY.most_partners].tolist() if i != photo)


def _common_features(rows: np.ndarray, others: Sequence[np.ndarray]) -> np.ndarray:
    """For each other photo, the number of features `rows` whose nearest there is clearly nearer than the second."""
    sampled = CAMERA_POLICY.compared_features
    everything = np.zeros((len(others), sampled, rows.shape[1]), np.float32)
    for place, other in zip(everything, others, strict=True):
        place[: len(other)] = other
    cosines = (rows @ everything.reshape(-1, rows.shape[1]).T).reshape(len(rows), len(others), sampled)
    nearest = cosines.argmax(-1)[..., None]
    first = np.take_along_axis(cosines, nearest, -1)[..., 0]
    np.put_along_axis(cosines, nearest, -1, -1)
    # |a − b|² = 2 − 2·cos for unit vectors, so the ratio of distances enters squared.
    ratio = CAMERA_POLICY.compared_ratio**2
    return np.asarray(np.count_nonzero(1 - first < ratio * (1 - cosines.max(-1)), axis=0))


def resembling(descriptors: Sequence[np.ndarray]) -> np.ndarray:
    """Which photos' features are worth comparing, [photos, photos] bool, symmetric: of many photos, those of a look.

    A photo's look is its vector of locally aggregated descriptors (VLAD; Jégou et al. 2010), each visual word
    normalised by itself (Arandjelović & Zisserman 2013). Each photo has the `CAMERA_POLICY.looked_up` nearest ones.
    """
    count, most = len(descriptors), CAMERA_POLICY.looked_up
    if count <= most + 1:
        near = np.ones((count, count), bool)
    else:
        looks, near = _looks(descriptors), np.zeros((count, count), bool)
        for rows in np.array_split(np.arange(count), count // most):
            nearest = np.argsort(-(looks[rows] @ looks.T), axis=1, kind="stable")[:, : most + 1]
            near[rows[:, None], nearest] = True
        near |= near.T
    np.fill_diagonal(near, False)
    return near


def _looks(descriptors: Sequence[np.ndarray]) -> np.ndarray:
    """Unit vectors [photos, words · 128], or zeros for a photo without features."""
    words = _visual_words(np.concatenate(descriptors))
    looks = np.zeros((len(descriptors), *words.shape), np.float32)
    for look, rows in zip(looks, descriptors, strict=True):
        if len(rows):
            nearest, _ = vq(rows, words)
            np.add.at(look, nearest, rows - words[nearest])
    looks /= np.maximum(np.linalg.norm(looks, axis=2, keepdims=True), 1e-12)
    looks = looks.reshape(len(looks), -1)
    return np.asarray(looks / np.maximum(np.linalg.norm(looks, axis=1, keepdims=True), 1e-12))


def _visual_words(descriptors: np.ndarray) -> np.ndarray:
    """Centres [words, 128] of clusters of the descriptors [n, 128]; these themselves where few are distinct."""
    policy = CAMERA_POLICY
    distinct = np.unique(descriptors[:: max(1, len(descriptors) // policy.word_samples)], axis=0)
    if len(distinct) <= policy.words:
        return distinct
    with warnings.catch_warnings(action="ignore"):  # a cluster may become empty, and keeps its centre then
        return np.asarray(kmeans2(distinct, policy.words, minit="++", seed=0)[0])
