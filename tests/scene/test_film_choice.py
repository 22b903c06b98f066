"""The frames of films that become photos."""

from dataclasses import replace
from itertools import chain
from pathlib import Path

import cv2
import numpy as np
import pytest

from film_files import pan, write_film
from querysplat_cli.scene import film_survey
from querysplat_cli.scene.film_choice import choose_frames
from querysplat_cli.scene.film_survey import FilmSurvey, survey_film
from querysplat_cli.scene.films import film_frames
from querysplat_cli.scene.policy import FILM_POLICY


def surveyed(path: Path) -> FilmSurvey:
    return survey_film(path, lambda share: None)


def made_up(travel: np.ndarray, sharpness: np.ndarray | None = None) -> FilmSurvey:
    count = len(travel)
    sharp = np.ones(count) if sharpness is None else sharpness
    return FilmSurvey(Path("film.mp4"), np.arange(count), np.arange(count) / 10, sharp, travel, count)


def test_travel_is_measured_in_longer_sides(tmp_path: Path) -> None:
    steps = np.arange(0, 400, 8)
    survey = surveyed(write_film(tmp_path / "pan.mp4", pan(steps)))
    assert survey.frames == len(steps)
    np.testing.assert_allclose(survey.travel, steps / 192, atol=0.05)


def test_a_shaking_hand_does_not_travel(tmp_path: Path) -> None:
    shake = 100 + np.random.default_rng(0).integers(-3, 4, 40)
    assert surveyed(write_film(tmp_path / "still.mp4", pan(shake))).travel[-1] < 0.05


def test_a_cut_is_a_whole_step(tmp_path: Path) -> None:
    survey = surveyed(write_film(tmp_path / "cut.mp4", pan([0, 0, 0, 900, 900, 900])))
    assert survey.travel[2] < 0.01
    assert survey.travel[3] >= FILM_POLICY.step


def test_another_size_in_the_middle_of_a_film_is_a_whole_step(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    one, other = (write_film(tmp_path / f"{width}.mp4", pan([0, 0, 0], width)) for width in (192, 128))
    frames = [replace(frame, seconds=0.1 * i) for i, frame in enumerate(chain(film_frames(one), film_frames(other)))]
    monkeypatch.setattr(film_survey, "film_frames", lambda path: iter(frames))
    survey = surveyed(one)
    assert survey.travel[2] < 0.01
    assert survey.travel[3] == pytest.approx(survey.travel[2] + FILM_POLICY.step)
    assert survey.travel[5] == pytest.approx(survey.travel[3], abs=0.01)


def test_frames_are_taken_by_motion_not_by_time(tmp_path: Path) -> None:
    """A camera that stands, then moves fast, then slowly: the standing part gives one frame."""
    places = np.concatenate([np.zeros(30), np.arange(0, 300, 15), 300 + np.arange(0, 150, 5)])
    (choice,) = choose_frames([surveyed(write_film(tmp_path / "walk.mp4", pan(places)))])
    chosen = places[list(choice.rows)]
    assert (chosen == 0).sum() <= 1
    assert 20 <= len(chosen) <= 40
    assert np.diff(chosen).max() < 0.15 * 192


def test_the_sharpest_frame_near_each_place_is_taken(tmp_path: Path) -> None:
    pictures = pan(np.arange(0, 400, 2))
    blurred = [i for i in range(len(pictures)) if i % 3]
    for i in blurred:
        pictures[i] = cv2.blur(pictures[i], (9, 9))
    (choice,) = choose_frames([surveyed(write_film(tmp_path / "walk.mp4", pictures))])
    assert len(choice.rows) > 20
    assert not set(choice.rows) & set(blurred)


def test_what_is_left_out_is_counted() -> None:
    sharpness = np.ones(100)
    sharpness[10:20:2] = 0.1
    (choice,) = choose_frames([made_up(np.linspace(0, 4, 100), sharpness)], 20)
    assert len(choice.rows) == 20
    assert choice.left_out == "80 of its 100 frames: 5 blurred, 75 close to those used"
    (all_used,) = choose_frames([made_up(np.linspace(0, 4, 30))], 30)
    assert all_used.left_out == ""


def test_of_two_blurred_neighbours_one_is_kept() -> None:
    sharpness = np.ones(60)
    sharpness[20:24] = 0.1
    (choice,) = choose_frames([made_up(np.linspace(0, 6, 60), sharpness)], 60)
    assert [row for row in range(60) if row not in choice.rows] == [20, 22]


@pytest.mark.parametrize("most", [1, 2, 7, 50])
def test_no_more_frames_than_asked_for(most: int) -> None:
    one, two = choose_frames([made_up(np.linspace(0, 6, 90)), made_up(np.linspace(0, 3, 40))], most)
    count = len(one.rows) + len(two.rows)
    assert max(2, most - 3) <= count <= max(2, most)
    if most > 2:
        assert len(one.rows) > len(two.rows)


def test_auto_has_bounds() -> None:
    (long,) = choose_frames([made_up(np.linspace(0, 500, 5000))])
    (short,) = choose_frames([made_up(np.linspace(0, 0.5, 500))])
    (still,) = choose_frames([made_up(np.zeros(500))])
    assert len(long.rows) == FILM_POLICY.most_frames
    assert len(short.rows) == FILM_POLICY.fewest_frames
    assert len(still.rows) == 1


def test_jumps_are_no_places_for_frames() -> None:
    """A picture a second, each far from the last: every one is taken, and none twice."""
    (choice,) = choose_frames([made_up(np.arange(12) * 0.3)])
    assert choice.rows == tuple(range(12))
