"""Matches of affine features are kept where their neighbours support them, and more are found around these."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic import FOCAL, camera, photographs, room

from querysplat_cli.encoders.classical.search import MatcherChoice, search
from querysplat_cli.encoders.classical.supported_matches import ShapedFeatures, supported_rows

SIZE = (300, 400)
MAP = np.array([[0.8, -0.5], [0.3, 1.1]])
"""How the first picture is mapped to the second, around the middle."""


def unit(vectors: np.ndarray) -> np.ndarray:
    return (vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)).astype(np.float32)


def features(pixels: np.ndarray, shapes: np.ndarray, descriptors: np.ndarray) -> ShapedFeatures:
    return ShapedFeatures(SIZE, pixels, shapes, unit(descriptors))


def two_pictures(right: int, wrong: int, seed: int) -> tuple[ShapedFeatures, ShapedFeatures]:
    """Features n of both pictures look alike. They show the same where n < `right`; the others stand anywhere."""
    generator = np.random.default_rng(seed)
    count = right + wrong
    one = generator.uniform([20, 20], [380, 280], (count, 2))
    two = np.array([200, 150]) + (one - [200, 150]) @ MAP.T + generator.normal(0, 0.3, (count, 2))
    two[right:] = generator.uniform([20, 20], [380, 280], (wrong, 2))
    turns = [2.0 * np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]) for a in generator.uniform(0, 7, count)]
    shapes = np.stack(turns)
    mapped = MAP @ shapes
    mapped[right:] = np.stack(turns[::-1])[:wrong]
    first = generator.normal(size=(count, 64))
    second = first + 0.3 * generator.normal(size=first.shape)
    return features(one, shapes, first), features(two, mapped, second)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_wrong_matches_have_no_support_and_right_ones_have(seed: int) -> None:
    rows = supported_rows(*two_pictures(120, 120, seed))
    agree = rows[:, 0] == rows[:, 1]
    assert (agree & (rows[:, 0] < 120)).sum() > 100
    assert (rows[:, 0] >= 120).mean() < 0.05


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_pictures_of_different_things_have_next_to_no_matches(seed: int) -> None:
    assert len(supported_rows(*two_pictures(0, 300, seed))) < 15


def test_a_feature_that_looks_like_another_one_far_away_is_found_where_its_neighbours_expect_it() -> None:
    """By looks alone the mutual nearest match would be another feature; the place decides."""
    one, two = two_pictures(100, 0, 3)
    alike, confused = one.descriptors.copy(), two.descriptors.copy()
    alike[90] = unit(alike[23] + 0.8 * alike[90])
    confused[23], confused[90] = unit(0.4 * alike[23] + 0.6 * alike[90]), unit(0.6 * alike[23] + 0.4 * alike[90])
    nearest = (alike @ confused.T).argmax(1)
    assert nearest[23] == 90
    assert nearest[90] == 23
    rows = supported_rows(replace(one, descriptors=alike), replace(two, descriptors=confused)).tolist()
    assert [23, 23] in rows
    assert [90, 90] in rows


def test_no_features_make_no_matches() -> None:
    empty = features(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.ones((0, 64)))
    assert supported_rows(empty, two_pictures(20, 0, 0)[0]).shape == (0, 2)


def test_two_photos_from_places_far_apart_are_placed() -> None:
    """The usual search finds no match that stands out."""
    apart = [camera(place) for place in ((-1.2, 0, 1.5), (1.2, 0.3, 1.9))]
    photos = [replace(photo, focal=FOCAL) for photo in photographs(room(), apart)]
    usual, found = (
        search(photos, MatcherChoice(matcher), seed=0, progress=lambda text, fraction: None)
        for matcher in ("sift", "sift-affine")
    )
    assert found.model
    turns = [two.w2c[:3, :3] @ one.w2c[:3, :3].T for one, two in (found.model.cameras.values(), apart)]
    error = np.degrees(np.arccos(np.clip((np.trace(turns[0] @ turns[1].T) - 1) / 2, -1, 1)))
    assert usual.model is None
    assert error < 2


def test_photos_of_different_places_are_not_placed() -> None:
    """Noise of different seeds: some features of a picture resemble some of the other one, neighbours and all."""
    view = camera((-1.6, 0, 1.5))
    photos = [photographs(room(seed), [view])[0] for seed in (0, 50)]
    found = search(photos, MatcherChoice("sift-affine"), seed=0, progress=lambda text, fraction: None)
    assert found.model is None
    assert not found.matches.pairs
