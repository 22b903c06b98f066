"""Matches of a few photos that rest, because something lies over the photos."""

from dataclasses import replace

import cv2
import numpy as np
import pycolmap
import pytest
from synthetic import arc, photographs, room

from querysplat_cli.encoders.base import CameraRequest
from querysplat_cli.encoders.classical.cameras import estimate_cameras
from querysplat_cli.encoders.classical.matches import Matches, matched
from querysplat_cli.encoders.classical.policy import CAMERA_POLICY
from querysplat_cli.encoders.classical.resting_matches import resting_matches, without_resting_matches
from querysplat_cli.encoders.classical.verified_pairs import read_candidates
from querysplat_cli.scene.views import Photo

SIZE = 480, 640
RANDOM = np.random.default_rng(0)
PLACES = RANDOM.uniform((-2, -1.5, 4), (2, 1.5, 8), (120, 3))
LOGO = RANDOM.uniform((20, 430), (160, 460), (90, 2))


def pixels(points: np.ndarray, shift: tuple[float, float, float]) -> np.ndarray:
    """The points seen by a camera at `shift` that looks along z."""
    x, y, z = (points - shift).T
    return np.column_stack([500 * x / z + 320, 500 * y / z + 240])


def found(moved: np.ndarray, resting: np.ndarray, shift: tuple[float, float, float]) -> np.ndarray:
    """Of matches of points that moved against the camera by `shift`, followed by pixels that rest."""
    one, two = (np.concatenate([pixels(moved, where), resting]) for where in ((0.0, 0.0, 0.0), shift))
    return resting_matches(one, two + RANDOM.normal(0, 0.1, two.shape), SIZE)


def test_a_logo_rests_where_the_camera_moved() -> None:
    assert found(PLACES, LOGO, (0.8, 0.1, 0.2)).tolist() == [False] * 120 + [True] * 90


@pytest.mark.parametrize("shift", [(0.0, 0.0, 0.0), (0.02, 0.0, 0.0)])
def test_a_camera_that_hardly_moved_has_no_resting_matches(shift: tuple[float, float, float]) -> None:
    assert not found(PLACES, LOGO, shift).any()


def test_a_car_before_a_resting_camera_is_not_the_scene() -> None:
    car = PLACES * [0.15, 0.15, 1.0]
    still = RANDOM.uniform(0, SIZE[::-1], (300, 2))
    assert not found(car, still, (0.8, 0.1, 0.2)).any()
    assert found(PLACES, still[still[:, 1] > 400], (0.8, 0.1, 0.2)).any()


def test_few_matches_that_moved_say_nothing() -> None:
    assert not found(PLACES[: CAMERA_POLICY.fewest_two_view_points - 1], LOGO, (0.8, 0.1, 0.2)).any()


def under_a_logo(photo: Photo) -> Photo:
    picture = photo.pixels.copy()
    for row, text in enumerate(("SHOT ON X9 PRO", "AI QUAD CAMERA", "2026-11-28 12:00")):
        place = (10, photo.height - 12 - 20 * row)
        cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.6, (255, 255, 255), 2, cv2.LINE_AA)
    return replace(photo, pixels=picture)


def shifts(matches: Matches) -> np.ndarray:
    """How far the matches of the first two photos move, in pixels."""
    with pycolmap.Database.open(matches.database) as store:
        pair = read_candidates(store, 0, 1)
    return np.asarray(np.linalg.norm(pair.first_pixels - pair.second_pixels, axis=1))


@pytest.mark.parametrize("count", [2, 3])
def test_cameras_of_photos_under_a_logo(count: int) -> None:
    plain = photographs(room(), arc(count))
    photos = [under_a_logo(photo) for photo in plain]
    with matched(photos, seed=0, progress=lambda *_: None) as matches:
        before = shifts(matches)
        without = without_resting_matches(matches, seed=0)
        after = shifts(without)
    assert np.count_nonzero(before < CAMERA_POLICY.resting) > 10
    assert sorted(after) == sorted(before[before >= CAMERA_POLICY.resting])
    assert [pair.ends for pair in without.pairs] == [pair.ends for pair in matches.pairs]
    one, two = (estimate_cameras(each, CameraRequest(192, seed=0), lambda *_: None) for each in (plain, photos))
    np.testing.assert_allclose(one.cameras.w2c[:, :3, :3], two.cameras.w2c[:, :3, :3], atol=0.03)


def test_many_photos_are_left_to_their_overlays() -> None:
    """Five photos of one size and more have those masked before anything is matched."""
    photos = [under_a_logo(photo) for photo in photographs(room(), arc(CAMERA_POLICY.few_photos + 1))]
    with matched(photos, seed=0, progress=lambda *_: None) as matches:
        assert without_resting_matches(matches, seed=0) is matches
