"""Features and matches of other kinds, beside those of SIFT in COLMAP's database."""

from collections.abc import Mapping

import numpy as np
import pycolmap


def append_features(store: pycolmap.Database, features: Mapping[int, np.ndarray]) -> None:
    """Put features behind those that each photo has. They get no descriptors.

    `features` are by photo number: COLMAP's keypoints [n, 4 or 6], or pixels [n, 2] with centres at +0.5.
    """
    for photo, found in features.items():
        own = store.read_keypoints(photo + 1)
        new = np.zeros((len(found), own.shape[1]), np.float32)
        new[:, : found.shape[1]] = found
        if found.shape[1] == 2:
            new[:, 2] = 1.0
            new[:, 5:] = 1.0  # of an affine shape, which starts with a circle
        store.update_keypoints(photo + 1, np.concatenate([own, new]))


def append_matches(store: pycolmap.Database, matches: Mapping[tuple[int, int], np.ndarray]) -> list[tuple[int, int]]:
    """Put matches (rows of features [m, 2]) behind those of each pair of photos, and return the pairs in order.

    A feature is matched once at most, so that no correspondence counts twice: the earlier match stays. What verified
    the pair is deleted.
    """
    for (first, second), rows in matches.items():
        numbers = first + 1, second + 1
        own = store.read_matches(*numbers) if store.exists_matches(*numbers) else np.zeros((0, 2), np.uint32)
        if store.exists_matches(*numbers):
            store.delete_matches(*numbers)
        if store.exists_two_view_geometry(*numbers):
            store.delete_two_view_geometry(*numbers)
        store.write_matches(*numbers, _once(np.concatenate([own, rows.astype(np.uint32)])))
    return sorted(matches)


def _once(rows: np.ndarray) -> np.ndarray:
    """The matches [m, 2] without those of a feature that an earlier one has."""
    for column in (0, 1):
        rows = rows[np.sort(np.unique(rows[:, column], return_index=True)[1])]
    return rows
