"""Which model is taken: of two places, of a moving camera with a burst, and of photos that were cut."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from synthetic import arc, camera
from test_cameras_parts import scene

from querysplat_cli.encoders.classical import mapping
from querysplat_cli.encoders.classical.mapping import Mapped
from querysplat_cli.encoders.classical.matches import Matches, Pair
from querysplat_cli.encoders.classical.pure_rotation import placed_by_rotation
from querysplat_cli.encoders.classical.sparse_model import SparseModel


@pytest.fixture
def cloud() -> np.ndarray:
    return np.random.default_rng(0).uniform([-1.5, -1, 4], [1.5, 1, 7], (300, 3))


def test_what_a_cut_photo_states_does_not_hold(cloud: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    found, matches = scene(arc(6), cloud)
    pulled = replace(found)
    monkeypatch.setattr(mapping, "centred", lambda reconstruction, **lenses: reconstruction)
    monkeypatch.setattr(mapping, "self_calibrated", lambda plain, fit_lens: plain)
    monkeypatch.setattr(mapping, "from_colmap", lambda reconstruction: found)
    monkeypatch.setattr(mapping, "bundle_adjusted", lambda *given: pulled)
    for share, worse, kept in ((1.0, 1.0, True), (0.85, 1.0, False), (0.7, 1.0, False), (0.7, 1.1, True)):
        monkeypatch.setattr(mapping, "mean_error", lambda model, pull=worse: pull if model is pulled else 1.0)
        stated = replace(matches, focals=(share * found.cameras[0].focal[0],) * 6)
        refined = Mapped(found, (), pycolmap.Reconstruction()).refined(stated)
        assert refined is (found if kept else pulled)


def test_a_burst_says_nothing_of_how_the_others_moved(cloud: np.ndarray) -> None:
    """36 pairs of nine photos from one place have most matches of all."""
    burst = [camera((-1.35, 0, 0.2), (0.01 * i, 0, 5)) for i in range(9)]
    _, matches = scene([*burst, *arc(4)[1:]], cloud)
    pairs = [
        pair
        if pair.second < 9
        else replace(pair, first_pixels=pair.first_pixels[:100], second_pixels=pair.second_pixels[:100])
        for pair in matches.pairs
    ]
    assert placed_by_rotation(replace(matches, pairs=tuple(pairs))) is None
    still = [pair for pair in pairs if pair.second < 9]
    assert placed_by_rotation(replace(matches, pairs=tuple(still))) is not None


def test_a_model_of_more_photos_is_worth_more_than_one_of_more_matches(
    cloud: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Five photos that all see one thing, eight of another place, and one that matches one of these by chance."""
    dense, matches = scene(arc(5), cloud)
    sparse, others = scene(arc(8), cloud[:60])
    pairs = [replace(pair, first=pair.first + 5, second=pair.second + 5) for pair in others.pairs]
    stray = Pair(5, 13, others.pairs[0].first_pixels, others.pairs[0].second_pixels)
    whole = Matches(Path(), matches.sizes[:1] * 14, (None,) * 14, (), (0,) * 14, (*matches.pairs, *pairs, stray))
    cameras, seen = ({photo + 5: each for photo, each in part.items()} for part in (sparse.cameras, sparse.seen))
    built = [(pycolmap.Reconstruction(), dense), (pycolmap.Reconstruction(), SparseModel(cameras, sparse.points, seen))]
    monkeypatch.setattr(Mapped, "misplaced", lambda self, matches: [])
    monkeypatch.setattr(mapping, "_mapped", lambda *given: [each for each, _ in built])
    monkeypatch.setattr(mapping, "_extended", lambda best, *given: best)
    monkeypatch.setattr(mapping, "from_colmap", lambda model: next(mine for each, mine in built if each is model))
    found = mapping.map_photos(whole, (), seed=0)
    assert found is not None
    assert sorted(found.model.cameras) == list(range(5, 13))
