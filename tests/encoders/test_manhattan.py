"""Straight lines tell a focal length where they run in three directions at right angles, and nothing elsewhere."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from querysplat_cli.encoders.classical.focal_from_lines import (
    combined,
    expected_focals,
    told_by_lines,
    tried_focals,
    usual_focals,
)
from querysplat_cli.encoders.classical.lens_prior import ExpectedFocal, usual_focal
from querysplat_cli.encoders.classical.manhattan import Lines, focal_evidence, straight_lines
from querysplat_cli.encoders.classical.policy import CAMERA_POLICY
from querysplat_cli.scene.views import Photo

SIZE = (480, 640)
USUAL = usual_focal(*SIZE)


def edges(turn: np.ndarray, focal: float, *, distortion: float = 0.0, seed: int = 0) -> np.ndarray:
    """Ends [n, 2, 2], in longer sides, of short edges of a town that a camera with this turn [3, 3] shows.

    Edges are parallel to the town's three axes, and scatter by a fifth of a pixel of 640.
    """
    generator = np.random.default_rng(seed)
    starts = generator.uniform([-3, -3, 4], [3, 3, 9], (900, 3)) @ turn
    steps = 0.8 * np.eye(3)[generator.integers(3, size=900)]
    world = np.stack([starts, starts + steps], axis=1) @ turn.T
    world = world[(world[..., 2] > 0.5).all(1)]
    flat = world[..., :2] / world[..., 2:]
    seen = focal * flat * (1 + distortion * (flat**2).sum(-1, keepdims=True))
    seen += generator.normal(0, 0.2 / 640, seen.shape)
    return np.asarray(seen[(np.abs(seen) < [0.5, 0.375]).all((1, 2))])


def found(lines: Lines, seed: int = 1) -> ExpectedFocal:
    tried = tried_focals(USUAL)
    return combined(USUAL, tried, [focal_evidence(lines, tried / 640, seed=seed)])


def turned(*, across: float, down: float, roll: float) -> np.ndarray:
    """A turn [3, 3] by so many degrees: to the side, then down, then around the viewing direction."""
    return np.asarray(cv2.Rodrigues(np.array([0, 0, np.radians(roll)]))[0]
        @ cv2.Rodrigues(np.array([np.radians(down), 0, 0]))[0]
        @ cv2.Rodrigues(np.array([0, np.radians(across), 0]))[0])  # fmt: skip


@settings(max_examples=8, deadline=None)
@given(st.floats(25, 65), st.floats(-25, -12), st.floats(-15, 15), st.sampled_from([0.5, 0.75, 1.2]))
def test_edges_at_right_angles_tell_the_focal_length(across: float, down: float, roll: float, focal: float) -> None:
    lines = Lines.between(edges(turned(across=across, down=down, roll=roll), focal))
    expected = found(lines)
    assert expected.pixels == pytest.approx(640 * focal, rel=0.04)
    assert expected.spread < 0.08


@pytest.mark.parametrize("distortion", [-0.2, 0.15])
def test_a_lens_that_bends_lines_has_its_focal_length(distortion: float) -> None:
    lines = Lines.between(edges(turned(across=40, down=-20, roll=4), 0.75, distortion=distortion))
    assert found(lines).pixels == pytest.approx(640 * 0.75, rel=0.06)


def test_lines_by_chance_tell_nothing() -> None:
    generator = np.random.default_rng(0)
    for seed in range(4):
        middles, angles = generator.uniform([-0.5, -0.375], [0.5, 0.375], (300, 2)), generator.uniform(0, np.pi, 300)
        halves = 0.03 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        assert found(Lines.between(np.stack([middles - halves, middles + halves], axis=1)), seed) == USUAL


def test_a_wall_seen_straight_on_tells_nothing() -> None:
    """Its lines are parallel to the picture, where any focal length explains them."""
    ends = edges(np.eye(3), 0.75)
    flat = ends[np.abs(ends[:, 1] - ends[:, 0]).min(1) < 2e-3]
    assert len(flat) > 50
    assert found(Lines.between(flat)) == USUAL


def test_few_lines_leave_the_usual_focal_length() -> None:
    assert found(Lines.between(edges(turned(across=40, down=-20, roll=0), 0.5)[:9])) == USUAL


def test_the_same_seed_gives_the_same_bits() -> None:
    lines, tried = Lines.between(edges(turned(across=30, down=-15, roll=0), 0.9)), tried_focals(USUAL) / 640
    assert (focal_evidence(lines, tried, seed=5) == focal_evidence(lines, tried, seed=5)).all()


def picture(focal: float) -> np.ndarray:
    """RGB [480, 640, 3]: edges of a town, drawn on grey."""
    canvas = np.full((*SIZE, 3), 90, np.uint8)
    for (x0, y0), (x1, y1) in edges(turned(across=35, down=-18, roll=3), focal, seed=2) * 640 + [320, 240]:
        shift = 4
        ends = [tuple(round(value * 2**shift) for value in end) for end in ((x0, y0), (x1, y1))]
        cv2.line(canvas, *ends, (220, 220, 220), 2, cv2.LINE_AA, shift)
    return canvas


def test_lines_are_found_in_pictures_and_not_under_masks() -> None:
    canvas = np.full((300, 400), 40, np.uint8)
    cv2.rectangle(canvas, (50, 60), (349, 239), 200, -1)
    lines = straight_lines(canvas)
    corners = (lines.ends.reshape(-1, 2) * 400 + [200, 150]).round()
    near = np.minimum(np.abs(corners - [50, 60]), np.abs(corners - [350, 240])).min(1)
    assert (near <= 2).all()
    mask = np.ones((300, 400), bool)
    mask[:, 200:] = False
    assert (straight_lines(canvas, mask).ends.mean(1)[:, 0] <= 0).all()


def test_two_photos_without_exif_get_what_their_lines_tell() -> None:
    pixels = picture(0.5)
    photos = [Photo(f"{name}.png", Path(f"{name}.png"), pixels) for name in "ab"]
    sizes = [(240, 320)] * 2
    usual, expected = usual_focals(photos, sizes), expected_focals(photos, sizes, seed=0)
    assert usual[0].pixels == pytest.approx(320 * CAMERA_POLICY.usual_focal)
    assert told_by_lines(expected[0])
    assert expected[0] == expected[1]
    assert expected[0].pixels == pytest.approx(320 * 0.5, rel=0.05)


def test_exif_and_many_photos_need_no_lines() -> None:
    photo = Photo("a.png", Path("a.png"), picture(0.5))
    sizes = [SIZE] * 5
    stated = [replace(photo, focal=500.0)] * 2
    assert expected_focals(stated, sizes[:2], seed=0) == usual_focals(stated, sizes[:2])
    assert expected_focals([photo] * 5, sizes, seed=0) == usual_focals([photo] * 5, sizes)
