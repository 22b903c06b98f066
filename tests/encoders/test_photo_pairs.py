"""Which photos are worth comparing, of many, and which are matched."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest

from querysplat_cli.encoders.classical import photo_pairs
from querysplat_cli.scene.resample import PinholeView
from querysplat_cli.scene.views import Photo

PLACES, EACH = 6, 5
Chosen = Callable[..., set[tuple[int, int]]]


def descriptors(seed: int) -> list[np.ndarray]:
    """Unit descriptors of photos of a few places, whose features are noisy copies of those of their place."""
    generator = np.random.default_rng(seed)
    places = generator.random((PLACES, 40, 128))
    rows = [place + 0.05 * generator.normal(size=place.shape) for place in places for _ in range(EACH)]
    return [(some / np.linalg.norm(some, axis=1, keepdims=True)).astype(np.float32) for some in rows]


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    changed = replace(photo_pairs.CAMERA_POLICY, looked_up=EACH - 1, most_partners=EACH - 1, words=16)
    monkeypatch.setattr(photo_pairs, "CAMERA_POLICY", changed)


@pytest.mark.usefixtures("few")
def test_photos_of_one_place_resemble_each_other() -> None:
    place = np.arange(PLACES * EACH) // EACH
    expected = (place[:, None] == place) & ~np.eye(PLACES * EACH, dtype=bool)
    assert np.array_equal(photo_pairs.resembling(descriptors(0)), expected)


@pytest.mark.usefixtures("few")
def test_a_photo_without_features_is_compared_like_any_other() -> None:
    rows = descriptors(1)
    rows[7] = rows[7][:0]
    near = photo_pairs.resembling(rows)
    assert np.array_equal(near, near.T)
    assert not near.diagonal().any()
    assert (near.sum(1) >= EACH - 1).all()


@pytest.mark.usefixtures("few")
@pytest.mark.parametrize("features", [0, 1, 12, 17])
def test_many_photos_of_one_picture_or_of_nothing(features: int) -> None:
    """k-means had no descriptors to begin with, or too few that differ."""
    near = photo_pairs.resembling([descriptors(5)[0][:features]] * 20)
    assert (near.sum(1) >= EACH - 1).all()


def test_few_photos_are_all_compared() -> None:
    near = photo_pairs.resembling(descriptors(0))
    assert near.sum() == PLACES * EACH * (PLACES * EACH - 1)


def shot(name: str, frame: int | None = None, view: PinholeView | None = None) -> Photo:
    """A photo of a file, or a frame of a film."""
    return Photo(name, Path(name), np.zeros((4, 4, 3), np.uint8), pts=frame, view=view)


@pytest.fixture
def chosen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Chosen:
    """Which of the photos are matched that have these descriptors."""

    def choose(photos: list[Photo], rows: Sequence[np.ndarray], **policy: Any) -> set[tuple[int, int]]:
        monkeypatch.setattr(photo_pairs, "_largest_features", lambda store, photo: rows[photo])
        changed = replace(photo_pairs.CAMERA_POLICY, exhaustive_photos=3, **policy)
        monkeypatch.setattr(photo_pairs, "CAMERA_POLICY", changed)
        with pycolmap.Database.open(tmp_path / "matches.db") as store:
            pairs = photo_pairs.choose_pairs(store, photos)
        assert pairs == sorted(set(pairs))
        return set(pairs)

    return choose


def test_neighbours_are_matched_and_near_frames_of_one_film(chosen: Chosen) -> None:
    photos = [*(shot("a.mp4", i) for i in range(10)), *(shot("b.mp4", i) for i in range(10)), shot("c.jpg")]
    expected = {(i, i + step) for step in (1, 2) for i in range(21 - step)}
    expected |= {(i, i + step) for step in (4, 8) for i in range(20 - step) if (i < 10) == (i + step < 10)}
    assert chosen(photos, descriptors(2)[:21], most_partners=0, film_steps=(4, 8)) == expected


def test_a_film_that_comes_back_is_matched_with_its_beginning(chosen: Chosen) -> None:
    rows = descriptors(3)
    loop = [rows[place * EACH] for place in range(PLACES)] + [rows[1]]
    assert (0, PLACES) in chosen([shot("a.mp4", i) for i in range(PLACES + 1)], loop, most_partners=1)


def test_views_of_one_panorama_are_never_matched(chosen: Chosen) -> None:
    view = PinholeView((0.25, 0.25), (0.12, 0.12), (0.125, 0.125))
    photos = [shot("a.jpg", view=view), shot("a.jpg", view=view), shot("b.jpg"), shot("c.jpg")]
    assert chosen(photos, descriptors(4)[:4], most_partners=0) == {(0, 2), (1, 2), (1, 3), (2, 3)}
