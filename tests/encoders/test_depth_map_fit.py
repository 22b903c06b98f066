"""Depth maps that came with photos of ray-cast scenes, in units of their own."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from synthetic import Plane, texture
from test_depth import SIDEWAYS, TWO_LAYERS, posed, seen_depth

from querysplat_cli.encoders.base import Geometry, PosedViews

PLAIN = np.full((256, 256, 3), 200, np.uint8)
PICTURES = [TWO_LAYERS[1], Plane((1.0, -0.6, 4.2), (1.0, 0, 0), (0, 1.2, 0), texture(3, 256))]
WALL = [Plane((-6, -4, 5.5), (12, 0, -1.5), (0, 8, 1.0), PLAIN), *PICTURES]
"""A white wall, slanted, behind two small pictures at different depths."""


def with_maps(scene: PosedViews, depth: np.ndarray) -> PosedViews:
    return replace(scene, depth_maps=torch.from_numpy(depth).float())


def error(geometry: Geometry, truth: np.ndarray) -> np.ndarray:
    assert geometry.depth is not None
    return np.abs(geometry.depth.numpy() / truth - 1)


@pytest.fixture(scope="module")
def white_wall() -> tuple[PosedViews, np.ndarray]:
    return posed(WALL, SIDEWAYS)


@pytest.mark.parametrize(
    ("sensor", "unit"),
    [
        pytest.param(lambda z, views: 1000 * z, 1000, id="millimetres"),
        pytest.param(lambda z, views: z * (1 + views / 4), None, id="a unit for each"),
        pytest.param(lambda z, views: 1 / (0.4 / z + 0.05), None, id="inverse depth with a shift"),
    ],
)
def test_a_white_wall_stands_where_the_map_says(white_wall, sensor, unit):
    scene, truth = white_wall
    wall = truth > 4.5
    assert np.mean(error(seen_depth(scene), truth)[wall] > 0.05) > 0.3
    geometry = seen_depth(with_maps(scene, sensor(truth, np.arange(len(truth))[:, None, None])))
    assert np.mean(error(geometry, truth)[wall] > 0.03) < 0.1  # stereo spreads the pictures a little
    assert geometry.depth_maps.given == geometry.depth_maps.used == tuple(range(len(truth)))
    assert geometry.depth_maps.difference < 0.01
    assert geometry.depth_maps.per_unit == (pytest.approx(unit, rel=0.01) if unit else None)
    assert float(geometry.confidence[torch.from_numpy(wall)].median()) >= 0.5
    assert geometry.warnings == ()


def test_a_map_that_does_not_fit_the_photos_is_not_used_and_named(white_wall):
    scene, truth = white_wall
    maps = truth.copy()
    maps[1] = np.random.default_rng(0).uniform(1, 9, truth[1].shape)
    geometry = seen_depth(with_maps(scene, maps))
    assert (geometry.depth_maps.given, geometry.depth_maps.used) == ((0, 1, 2, 3), (0, 2, 3))
    assert geometry.warnings == ("depth maps that do not fit what the photos show are not used: 1 (1.png)",)
    assert np.mean(error(geometry, truth)[[0, 2, 3]] > 0.05) < 0.1


def test_measured_depth_stays_beside_a_coarse_map(white_wall):
    scene, truth = white_wall
    coarse = truth[:, 8::16, 8::16].repeat(16, 1).repeat(16, 2)
    found, plain = seen_depth(with_maps(scene, coarse)), seen_depth(scene)
    measured = plain.confidence >= 0.75
    assert measured.float().mean() > 0.05
    torch.testing.assert_close(found.depth[measured], plain.depth[measured])


def test_a_single_photo_has_the_shape_of_its_map():
    scene, truth = posed(WALL, SIDEWAYS[:1], points=False)
    geometry = seen_depth(with_maps(scene, 1000 * truth))
    ratio = geometry.depth.numpy() / truth
    assert np.percentile(ratio, 95) / np.percentile(ratio, 5) < 1.02
    assert geometry.depth_maps.difference is None
    assert geometry.warnings == ()


def test_views_without_a_map_are_as_good_as_before(white_wall):
    scene, truth = white_wall
    maps = truth.copy()
    maps[2:] = 0
    geometry = seen_depth(with_maps(scene, maps))
    assert geometry.depth_maps.given == (0, 1)
    wall = truth > 4.5
    before = seen_depth(scene)
    for view in (2, 3):
        now, then = (np.mean(error(each, truth)[view][wall[view]] > 0.05) for each in (geometry, before))
        assert now <= then


def test_a_map_that_cannot_be_compared_needs_the_unit_of_the_others(white_wall):
    scene, truth = white_wall
    hidden = scene.views.masks.clone()
    hidden[3] &= torch.from_numpy(truth[3] > 4.5)
    lone = replace(scene, views=replace(scene.views, masks=hidden))
    for units, used in (([1, 1, 1, 1], 4), ([1, 2, 3, 4], 3)):
        maps = truth * np.array(units)[:, None, None] * hidden.numpy()
        geometry = seen_depth(with_maps(lone, maps))
        assert geometry.depth_maps.given == (0, 1, 2, 3)
        assert len(geometry.depth_maps.used) == used


def test_maps_without_a_single_distance_change_nothing(white_wall):
    scene, truth = white_wall
    found, plain = seen_depth(with_maps(scene, 0 * truth)), seen_depth(scene)
    assert found.depth_maps.given == found.depth_maps.used == ()
    assert torch.equal(found.depth, plain.depth)
