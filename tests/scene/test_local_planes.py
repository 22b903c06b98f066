"""Planes by weighted least squares around each pixel."""

from functools import partial

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

from querysplat_cli.scene.local_planes import local_planes

SHAPE = (20, 30)
SMOOTH = partial(gaussian_filter, sigma=5.0, mode="constant")
SLOPES = st.floats(-0.01, 0.01)


@given(SLOPES, SLOPES)
def test_a_plane_is_found_from_a_part_of_it(along: float, down: float) -> None:
    y, x = np.indices(SHAPE) + 0.5
    weight = np.zeros(SHAPE)
    weight[4:14, 5:18] = 1
    found = local_planes(np.where(weight > 0, 1 + along * x + down * y, 7.0), weight, SMOOTH, 0.01)
    np.testing.assert_allclose(found.slope_x, along, atol=1e-5)
    np.testing.assert_allclose(found.slope_y, down, atol=1e-5)
    np.testing.assert_allclose(found.mean, 1 + along * found.x + down * found.y, atol=1e-4)


def test_a_floor_comes_nearer_towards_the_bottom_and_farther_towards_the_top() -> None:
    y, x = np.indices(SHAPE) + 0.5
    floor, weight = 1 + 0.01 * y, np.zeros(SHAPE)
    weight[8:12] = 1
    np.testing.assert_allclose(local_planes(floor, weight, SMOOTH, 0.01).at(x, y, 1.0), floor, atol=1e-3)


def test_a_wall_goes_away_to_one_side_and_comes_nearer_to_none() -> None:
    y, x = np.indices(SHAPE) + 0.5
    wall, weight = 1 + 0.01 * x, np.zeros(SHAPE)
    weight[:, 14:16] = 1
    found = local_planes(wall, weight, SMOOTH, 0.01).at(x, y, 1.0)
    np.testing.assert_allclose(found[:, :14], wall[:, :14], atol=1e-3)
    assert found[:, 16:].max() < wall[0, 16]


def test_surroundings_smaller_than_the_ridge_tilt_nothing() -> None:
    _, x = np.indices(SHAPE) + 0.5
    weight = np.zeros(SHAPE)
    weight[8:11, 10:13] = 1
    line = 1 + 0.01 * x
    np.testing.assert_allclose(local_planes(line, weight, SMOOTH, 0.01).slope_x, 0.01, rtol=0.01)
    assert np.abs(local_planes(line, weight, SMOOTH, 20.0).slope_x).max() < 0.001


def test_a_plane_is_continued_to_its_limit() -> None:
    y, x = np.indices(SHAPE) + 0.5
    found = local_planes(1 + 0.1 * y, np.ones(SHAPE), SMOOTH, 0.01)
    np.testing.assert_allclose(found.at(x, y + 1000, 0.5), 1.5 * found.mean)
    np.testing.assert_allclose(found.at(x, y - 1000, 0.5), 0.5 * found.mean)
