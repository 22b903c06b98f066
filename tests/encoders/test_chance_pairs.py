"""Pairs of different places that look alike are told from pairs that show one place from afar."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from querysplat_cli.encoders.classical.chance_pairs import remove_chance_pairs
from querysplat_cli.encoders.classical.matches import shared_cameras, write_images
from querysplat_cli.encoders.classical.verified_pairs import Pair, read_pairs

FEWEST = 15


def kept(folder: Path, photos: int, counts: Mapping[tuple[int, int], int]) -> set[tuple[int, int]]:
    """Which pairs with these numbers of matches stay, in the returned ones and in the database alike."""
    most = max(counts.values())
    pixels = np.zeros((most, 2), np.float32)
    with pycolmap.Database.open(folder / "matches.db") as store:
        write_images(store, shared_cameras([(100, 100)] * photos, [None] * photos))
        for photo in range(photos):
            store.write_keypoints(photo + 1, pixels)
        for (first, second), count in counts.items():
            rows = np.repeat(np.arange(count, dtype=np.uint32)[:, None], 2, 1)
            geometry = pycolmap.TwoViewGeometry()
            geometry.config, geometry.inlier_matches = pycolmap.TwoViewGeometryConfiguration.CALIBRATED, rows
            store.write_two_view_geometry(first + 1, second + 1, geometry)
        pairs = read_pairs(store, photos)
        assert {pair.ends: len(pair) for pair in pairs} == dict(counts)
        found = ends(remove_chance_pairs(store, pairs, photos, FEWEST))
        assert found == ends(read_pairs(store, photos))
    return found


def ends(pairs: tuple[Pair, ...]) -> set[tuple[int, int]]:
    return {pair.ends for pair in pairs}


WALK = {(i, i + step): count for step, count in ((1, 200), (2, 60), (3, 20)) for i in range(20 - step)}
"""Twenty photos of a walk: those three steps apart have few matches, those between them have more with both."""


def test_photos_between_support_a_pair_with_few_matches(tmp_path: Path) -> None:
    assert kept(tmp_path, 20, WALK) == WALK.keys()


def test_places_that_look_alike_are_told_apart(tmp_path: Path) -> None:
    alike = {(2 + i, 14 + j): 18 + i + j for i in range(3) for j in range(3)}
    assert kept(tmp_path, 20, {**WALK, **alike}) == WALK.keys()


def test_the_end_of_a_round_meets_its_start(tmp_path: Path) -> None:
    """With many matches, or with few of photos whose neighbours have many."""
    closed = {(0, 19): 45, (1, 19): 20, (0, 18): 22}
    assert kept(tmp_path, 20, {**WALK, **closed}) == {*WALK, *closed}


@pytest.mark.parametrize("count", [FEWEST, 29])
def test_a_pair_that_alone_connects_two_groups_stays(tmp_path: Path, count: int) -> None:
    bridge = {(5, 26): count}
    other = {(first + 20, second + 20): matches for (first, second), matches in WALK.items()}
    assert kept(tmp_path, 40, {**WALK, **other, **bridge}) == {*WALK, *other, *bridge}
