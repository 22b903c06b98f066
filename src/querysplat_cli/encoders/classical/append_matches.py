"""Features and matches in COLMAP's database beside those of SIFT, or in their place."""

from collections.abc import Mapping

import numpy as np
import pycolmap

from querysplat_cli.encoders.classical.verified_pairs import matched_rows


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

    See `replace_matches`.
    """
    return replace_matches(
        store, {pair: np.concatenate([matched_rows(store, *pair), rows]) for pair, rows in matches.items()}
    )


def replace_matches(store: pycolmap.Database, matches: Mapping[tuple[int, int], np.ndarray]) -> list[tuple[int, int]]:
    """Put matches (rows of features [m, 2]) in place of those of each pair of photos, and return the pairs in order.

    A feature is matched once at most, so that no correspondence counts twice: the earlier match stays. What verified
    the pair is deleted.
    """
    for (first, second), rows in matches.items():
        numbers = first + 1, second + 1
        if store.exists_matches(*numbers):
            store.delete_matches(*numbers)
        if store.exists_two_view_geometry(*numbers):
            store.delete_two_view_geometry(*numbers)
        store.write_matches(*numbers, _once(rows.astype(np.uint32)))
    return sorted(matches)


def _once(rows: np.ndarray) -> np.ndarray:
    """The matches [m, 2] without those of a feature that an earlier one has."""
    for column in (0, 1):
        rows = rows[np.sort(np.unique(rows[:, column], return_index=True)[1])]
    return rows
