"""Which photos are worth comparing, of many."""

from dataclasses import replace

import numpy as np
import pytest

from querysplat_cli.encoders.classical import photo_pairs

PLACES, EACH = 6, 5


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


def test_few_photos_are_all_compared() -> None:
    near = photo_pairs.resembling(descriptors(0))
    assert near.sum() == PLACES * EACH * (PLACES * EACH - 1)
