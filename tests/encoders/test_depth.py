"""Depth against ray-cast scenes with known cameras, and against closed forms."""

import numpy as np
import pytest
import torch
from synthetic import Plane, camera, photograph, texture

from querysplat_cli.encoders.base import Geometry, PosedViews
from querysplat_cli.encoders.classical.consistency import DepthMaps, carve, confirm, lent
from querysplat_cli.encoders.classical.depth import estimate_geometry
from querysplat_cli.encoders.classical.depth_policy import DEPTH_POLICY
from querysplat_cli.encoders.classical.neighbours import choose_sources, inverse_range
from querysplat_cli.encoders.classical.patchmatch import Source
from querysplat_cli.encoders.classical.semiglobal import aggregate_costs, best_planes
from querysplat_cli.encoders.classical.sweep import WORST_COST, cost_volume, plane_homography
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.views import Views

SIZE, FOCAL = (144, 192), 180.0
SLANTED = [Plane((-4, -3, 4.5), (8, 0, -1.6), (0, 6, 1.0), texture(5, 1024))]
TWO_LAYERS = [
    Plane((-6, -4, 5), (12, 0, 0), (0, 8, 0), texture(1, 1024)),
    Plane((-0.5, -0.45, 3), (1.0, 0, 0), (0, 0.9, 0), texture(2, 256)),
]
SIDEWAYS = [(0, 0, 0), (0.3, 0, 0), (-0.3, 0.05, 0), (0, 0.3, 0)]


def true_depth(planes, photo_camera) -> np.ndarray:
    """Camera z of the first surface on the ray of every pixel centre."""
    v, u = np.mgrid[: photo_camera.height, : photo_camera.width] + 0.5
    rays = np.stack(
        [
            (u - photo_camera.principal[0]) / photo_camera.focal[0],
            (v - photo_camera.principal[1]) / photo_camera.focal[1],
            1 + 0 * u,
        ],
        -1,
    )
    directions, centre = rays @ photo_camera.w2c[:3, :3], -photo_camera.w2c[:3, :3].T @ photo_camera.w2c[:3, 3]
    nearest = np.full(u.shape, np.inf)
    for plane in planes:
        across, down = np.array(plane.across, float), np.array(plane.down, float)
        normal = np.cross(across, down)
        z = (np.subtract(plane.corner, centre) @ normal) / (directions @ normal)
        offset = centre + directions * z[..., None] - plane.corner
        s, t = offset @ across / (across @ across), offset @ down / (down @ down)
        hit = (z > 0) & (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)
        nearest[hit] = np.minimum(nearest, z)[hit]
    return nearest


def posed(planes, places, look=(0, 0, 1000.0), points=True) -> tuple[PosedViews, np.ndarray]:
    """Views of the planes from the places, with every 12th pixel of the first as a sparse point; true depths."""
    taken_by = [camera(place, look, size=SIZE, focal=FOCAL) for place in places]
    pictures = [photograph(planes, each, f"{i}.png").pixels for i, each in enumerate(taken_by)]
    images = torch.from_numpy(np.stack(pictures)).permute(0, 3, 1, 2).float() / 255
    depth = np.stack([true_depth(planes, each) for each in taken_by])
    w2c = torch.from_numpy(np.stack([each.w2c for each in taken_by])).float()
    K = torch.tensor([[FOCAL, 0, SIZE[1] / 2], [0, FOCAL, SIZE[0] / 2], [0, 0, 1]]).repeat(len(places), 1, 1)
    cloud = sparse_points(taken_by[0], depth[0]) if points else torch.zeros(0, 3)
    names = tuple(f"{i}.png" for i in range(len(places)))
    views = Views(images, torch.ones(len(places), *SIZE, dtype=torch.bool), names, (SIZE,) * len(places))
    seen = tuple(torch.arange(len(cloud)) for _ in places)
    return PosedViews(views, Cameras(w2c, K, *SIZE), cloud, seen), depth


def sparse_points(photo_camera, depth: np.ndarray) -> torch.Tensor:
    """The scene's points [n, 3] in every 12th pixel of a photo of this depth."""
    height, width = depth.shape
    v, u = (part.ravel() + 0.5 for part in np.mgrid[6:height:12, 6:width:12])
    z = depth[v.astype(int), u.astype(int)]
    rays = np.stack([(u - width / 2) / FOCAL, (v - height / 2) / FOCAL, np.ones_like(u)], -1)[np.isfinite(z)]
    world = (rays * z[np.isfinite(z), None] - photo_camera.w2c[:3, 3]) @ photo_camera.w2c[:3, :3]
    return torch.from_numpy(world).float()


def everywhere(maps: np.ndarray) -> np.ndarray:
    """Masks of pictures that fill their canvas."""
    return np.ones(maps.shape, bool)


def seen_depth(scene: PosedViews) -> Geometry:
    geometry = estimate_geometry(scene, seed=0, progress=lambda text, fraction: None)
    assert bool((geometry.depth > 0).all())
    assert bool(geometry.depth.isfinite().all())
    assert 0 <= float(geometry.confidence.min()) <= float(geometry.confidence.max()) <= 1
    return geometry


def relative_error(geometry: Geometry, truth: np.ndarray, view: int = 0, border: int = 12) -> np.ndarray:
    inside = np.s_[border:-border, border:-border]
    return np.abs(geometry.depth[view].numpy() / truth[view] - 1)[inside]


@pytest.fixture(scope="module")
def slanted() -> tuple[PosedViews, np.ndarray, Geometry]:
    scene, truth = posed(SLANTED, SIDEWAYS)
    return scene, truth, seen_depth(scene)


def test_a_slanted_plane_is_measured_to_a_fraction_of_a_pixel_of_disparity(slanted):
    _, truth, geometry = slanted
    error = relative_error(geometry, truth)
    # One pixel of disparity is depth/(focal·baseline) ≈ 4/54 = 7 % of the depth here.
    assert np.median(error) < 0.004
    assert np.percentile(error, 95) < 0.02
    assert float(geometry.confidence[0].mean()) > 0.8
    assert geometry.warnings == ()


def test_the_edge_between_two_layers_lies_where_it_is():
    scene, truth = posed(TWO_LAYERS, SIDEWAYS)
    error = relative_error(seen_depth(scene), truth)
    edge = np.abs(np.diff(truth[0], axis=1, prepend=5)) + np.abs(np.diff(truth[0], axis=0, prepend=5)) > 1
    near_edge = np.asarray(torch.nn.functional.max_pool2d(torch.from_numpy(edge[None] * 1.0), 9, 1, 4)[0] > 0)
    near_edge = near_edge[12:-12, 12:-12]
    assert np.mean(error[~near_edge] > 0.03) < 0.02
    assert np.mean(error[near_edge] > 0.1) < 0.35


def test_two_views_are_enough():
    scene, truth = posed(SLANTED, SIDEWAYS[:2])
    error = relative_error(seen_depth(scene), truth, border=24)
    assert np.median(error) < 0.01


def test_forward_motion_with_the_epipole_in_the_picture():
    scene, truth = posed(SLANTED, [(0, 0, 0), (0.02, 0, 0.8), (0, 0.02, -0.6)])
    error = relative_error(seen_depth(scene), truth, border=24)
    rows, columns = np.mgrid[: error.shape[0], : error.shape[1]]
    away = np.hypot(rows - error.shape[0] / 2, columns - error.shape[1] / 2) > 30
    assert np.median(error[away]) < 0.02


def test_a_depth_range_of_one_to_a_thousand():
    scene, _ = posed(SLANTED, SIDEWAYS)
    points = torch.tensor([[0.0, 0, 1], [0.1, 0, 10], [0, 1, 100], [1, 1, 1000]]).repeat(3, 1)
    wide = PosedViews(scene.views, scene.cameras, points, tuple(torch.arange(12) for _ in SIDEWAYS))
    limits = inverse_range(wide, 0)
    assert limits.far < 1e-3
    assert limits.near > 1
    geometry = seen_depth(wide)
    assert float(geometry.depth.max()) <= 1.001 / limits.far


def test_a_post_before_a_wall_is_measured_though_few_points_lie_on_it():
    """Posts and the ground before the camera had a few points of thousands, and were put too far away for it."""
    post = Plane((-0.12, -0.3, 1.4), (0.24, 0, 0), (0, 0.6, 0), texture(3, 256))
    scene, truth = posed([TWO_LAYERS[0], post], [(0, 0, 0), (0.12, 0, 0), (-0.12, 0.02, 0), (0, 0.12, 0)])
    wall, near = scene.points[scene.points[:, 2] > 2].repeat(12, 1), scene.points[scene.points[:, 2] < 2][:4]
    assert len(near) == 4

    def with_points(points: torch.Tensor) -> PosedViews:
        return PosedViews(scene.views, scene.cameras, points, tuple(torch.arange(len(points)) for _ in truth))

    without, with_one = (inverse_range(with_points(torch.cat([wall, near[:n]])), 0) for n in (0, 1))
    assert with_one.near == pytest.approx(without.near, rel=0.01)
    assert without.near < 1 / 1.4
    assert inverse_range(with_points(near[:2]), 0).near == pytest.approx(1, rel=1e-3)
    found = with_points(torch.cat([wall, near]))
    assert inverse_range(found, 0).near == pytest.approx(1, rel=1e-3)
    error = np.abs(seen_depth(found).depth[0].numpy() / truth[0] - 1)
    assert np.median(error[truth[0] < 2]) < 0.02


def test_masked_pixels_do_not_vote_and_have_no_confidence(slanted):
    scene, truth, _ = slanted
    masks = scene.views.masks.clone()
    masks[:, :, :36] = False
    masks[2] = False
    images = scene.views.images.clone()
    images[~masks[:, None].expand_as(images)] = 0.5
    views = Views(images, masks, scene.views.names, scene.views.sizes)
    geometry = seen_depth(PosedViews(views, scene.cameras, scene.points, scene.visibility))
    assert float(geometry.confidence[~masks].max()) == 0
    error = np.abs(geometry.depth[0].numpy() / truth[0] - 1)[12:-12, 60:-12]
    assert np.median(error) < 0.01


def test_one_view_is_a_guess_and_raises_a_warning(slanted):
    scene, _, _ = slanted
    alone = PosedViews(scene.views[[0]], scene.cameras[[0]], torch.zeros(0, 3), (torch.zeros(0, dtype=torch.long),))
    geometry = seen_depth(alone)
    assert float(geometry.confidence.max()) == 0
    assert geometry.depth.unique().tolist() == [1.0]
    assert "parallax" in geometry.warnings[0]


def test_cameras_at_one_place_measure_nothing():
    scene, _ = posed(SLANTED, [(0, 0, 0), (0, 0, 0)])
    geometry = seen_depth(scene)
    assert float(geometry.confidence.max()) == 0
    assert geometry.warnings


def test_the_same_photos_give_the_same_bits(slanted):
    scene, _, first = slanted
    second = seen_depth(scene)
    assert torch.equal(first.depth, second.depth)
    assert torch.equal(first.confidence, second.confidence)


def test_sources_share_points_and_stand_apart(slanted):
    scene, _, _ = slanted
    assert sorted(choose_sources(scene)[0]) == [1, 2, 3]
    strangers = (scene.visibility[0], *(torch.zeros(0, dtype=torch.long) for _ in range(3)))
    assert choose_sources(PosedViews(scene.views, scene.cameras, scene.points, strangers))[0] == []


def test_a_plane_homography_maps_as_the_plane_does():
    K = np.array([[200, 0, 90], [0, 210, 70], [0, 0, 1.0]])
    transform = camera((0.3, -0.1, 0.2), (0.2, 0.1, 4)).w2c
    point = np.array([0.4, -0.3, 3.0])
    pixel, there = K @ point, K @ (transform[:3, :3] @ point + transform[:3, 3])
    mapped = plane_homography(K, K, transform, 1 / 3.0) @ (pixel / pixel[2])
    np.testing.assert_allclose(mapped / mapped[2], there / there[2], rtol=1e-12)


def test_costs_are_zero_at_the_true_plane_and_neutral_where_no_source_sees():
    generator = np.random.default_rng(0)
    wide = generator.random((40, 80)).astype(np.float32)
    K = np.array([[50, 0, 30], [0, 50, 20], [0, 0, 1.0]])
    shift = np.eye(4)
    shift[0, 3] = -1.0
    # Inverse depth q moves the picture by 50·q pixels to the left; 0.1 is five pixels.
    costs = cost_volume(wide[:, :60].copy(), K, [(wide[:, 5:65].copy(), K, shift)], np.array([0.0, 0.1, 0.2, 5.0]))
    assert costs[4:-4, 12:-4, 1].max() <= 1
    assert costs[4:-4, 12:-4, [0, 2]].mean() > 0.7 * WORST_COST
    assert set(costs[..., 3].ravel()) == {int(DEPTH_POLICY.unseen_cost * WORST_COST)}


def test_pixels_without_a_best_plane_take_that_of_their_neighbours():
    costs = np.full((9, 9, 5), 60, np.uint8)
    costs[..., 3] = 20
    costs[4, 4] = 60
    plane = best_planes(aggregate_costs(costs, np.full((9, 9), 0.5, np.float32)))
    np.testing.assert_array_equal(plane, 3)


def two_cameras() -> list[Source]:
    """Of 24 × 24 pixels. The second one stands half a unit further right."""
    beside, nothing = np.eye(4), np.zeros((24, 24), np.float32)
    beside[0, 3] = -0.5
    K = np.array([[24, 0, 12], [0, 24, 12], [0, 0, 1.0]])
    return [Source(nothing, K, w2c, nothing) for w2c in (np.eye(4), beside)]


def test_confirmation_counts_views_and_carving_clears_free_space():
    inverse = np.full((2, 24, 24), 0.5, np.float32)
    inverse[0, 8:16, 14:22] = 1.0
    confidence = confirm(inverse, everywhere(inverse), np.zeros_like(inverse), two_cameras(), [[1], [0]])
    # A pixel at depth 2 falls 6 pixels further left in the other view, one at depth 1 falls 12: on depth 2.
    assert confidence[0, 2:6, 8:].min() == 1
    assert confidence[0, 8:16, 14:22].max() == 0
    assert confidence[0, :, :6].max() == 0
    sure = np.ones_like(inverse)
    sure[0, 8:16, 14:22] = 0
    carved = carve(
        DepthMaps(inverse, sure, np.zeros((2, 24, 24, 3), np.float32), everywhere(inverse)),
        two_cameras(),
        [[1], [0]],
        [0.01, 0.01],
    )
    assert carved[0, 8:16, 14:22].max() <= 0.5 / 0.95 + 1e-6
    np.testing.assert_array_equal(carved[sure == 1], inverse[sure == 1])


@pytest.mark.parametrize(("own", "expected"), [(0.5, 0.5), (0.9, 0.0)])
def test_a_view_borrows_what_another_measured_in_the_same_colour(own: float, expected: float):
    inverse = np.full((2, 24, 24), 0.5, np.float32)
    confidence = np.stack([np.zeros((24, 24)), np.ones((24, 24))]).astype(np.float32)
    pictures = np.full((2, 24, 24, 3), 0.5, np.float32)
    pictures[0] = own
    borrowed = lent(DepthMaps(inverse, confidence, pictures, everywhere(inverse)), two_cameras(), [[1], [0]])
    # A pixel at depth 2 lies 6 pixels further right in the first view; the second measured nothing for the left ones.
    np.testing.assert_allclose(borrowed[0, :, 6:], expected)
    assert not borrowed[0, :, :6].any()
    assert not borrowed[1].any()


@pytest.mark.parametrize(("own", "other", "cleared"), [(0.0, 0.5, True), (0.3, 0.3, False)])
def test_a_guess_moves_back_behind_guesses_of_another_colour(own: float, other: float, cleared: bool):
    inverse = np.full((2, 24, 24), 0.5, np.float32)
    inverse[0, 8:16, 14:22] = 1.0
    pictures = np.full((2, 24, 24, 3), other, np.float32)
    pictures[0] = own
    carved = carve(
        DepthMaps(inverse, np.zeros_like(inverse), pictures, everywhere(inverse)),
        two_cameras(),
        [[1], [0]],
        [0.01, 0.01],
    )
    inside = carved[0, 10:14, 16:20]
    assert (inside.max() < 0.6) if cleared else (inside.min() == 1.0)
