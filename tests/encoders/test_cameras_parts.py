"""The parts of the camera search, each against a closed form."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from synthetic import arc, camera

from querysplat_cli.encoders.classical import mapping
from querysplat_cli.encoders.classical.camera_warnings import camera_warnings, is_flat, median_angle
from querysplat_cli.encoders.classical.encoder import ClassicalEncoder
from querysplat_cli.encoders.classical.epipolar import epipolar_error, epipolar_support, median_epipolar_error, rays
from querysplat_cli.encoders.classical.lens_prior import usual_focal
from querysplat_cli.encoders.classical.mapping import Mapped
from querysplat_cli.encoders.classical.matches import Matches, Pair
from querysplat_cli.encoders.classical.policy import CAMERA_POLICY
from querysplat_cli.encoders.classical.sparse_model import SparseModel, in_first_camera_frame
from querysplat_cli.encoders.registry import find_encoder
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.cameras import PhotoCamera, rescaled
from querysplat_cli.scene.undistort import undistorted
from querysplat_cli.scene.views import Photo


def project_distorted(points: np.ndarray, photo_camera: PhotoCamera) -> np.ndarray:
    """Pixels [n, 2] of world points under the Brown lens model, computed independently."""
    local = points @ photo_camera.w2c[:3, :3].T + photo_camera.w2c[:3, 3]
    x, y = (local[:, :2] / local[:, 2:]).T
    k1, k2, p1, p2 = photo_camera.distortion
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.stack(
        [photo_camera.focal[0] * u + photo_camera.principal[0], photo_camera.focal[1] * v + photo_camera.principal[1]],
        1,
    )


def scene(cameras: list[PhotoCamera], points: np.ndarray) -> tuple[SparseModel, Matches]:
    """A perfect model and its matches: every camera sees every point."""
    seen = {i: np.arange(len(points)) for i in range(len(cameras))}
    pixels = [project_distorted(points, photo_camera) for photo_camera in cameras]
    pairs = [Pair(i, j, pixels[i], pixels[j]) for i in range(len(cameras)) for j in range(i + 1, len(cameras))]
    sizes = tuple((photo_camera.height, photo_camera.width) for photo_camera in cameras)
    count = len(cameras)
    usual = tuple(usual_focal(*size) for size in sizes)
    matches = Matches(Path(), sizes, (None,) * count, usual, (len(points),) * count, tuple(pairs))
    return SparseModel(dict(enumerate(cameras)), points, seen), matches


@pytest.fixture
def cloud() -> np.ndarray:
    return np.random.default_rng(0).uniform([-1.5, -1, 4], [1.5, 1, 7], (300, 3))


def test_rays_undo_the_lens(cloud: np.ndarray) -> None:
    photo_camera = camera((0.2, 0.1, 0), distortion=(-0.1, 0.02, 0.001, -0.002))
    local = cloud @ photo_camera.w2c[:3, :3].T + photo_camera.w2c[:3, 3]
    assert rays(project_distorted(cloud, photo_camera), photo_camera) == pytest.approx(
        local[:, :2] / local[:, 2:], abs=2e-4
    )


def test_epipolar_error_is_zero_for_the_truth_and_pixels_for_a_shift(cloud: np.ndarray) -> None:
    first, second = camera((0, 0, 0), (0, 0, 5)), camera((1, 0, 0), (1, 0, 5))
    pixels = project_distorted(cloud, first), project_distorted(cloud, second)
    assert epipolar_error(Pair(0, 1, *pixels), first, second) == pytest.approx(0, abs=1e-9)
    # The motion is along x, so epipolar lines are rows; each photo takes half of the vertical shift.
    shifted = Pair(0, 1, pixels[0], pixels[1] + [0, 2])
    assert epipolar_error(shifted, first, second) == pytest.approx(2 / 2**0.5, rel=1e-6)


def test_support_finds_a_turned_camera(cloud: np.ndarray) -> None:
    model, matches = scene(arc(4), cloud)
    assert epipolar_support(model, matches).share == 1
    assert epipolar_support(model, matches).sound
    assert not camera_warnings(model, matches)
    bent = replace(model, cameras={**model.cameras, 1: model.cameras[2], 2: model.cameras[1]})
    assert not epipolar_support(bent, matches).sound
    assert "agree with the cameras" in camera_warnings(bent, matches)[0]


def test_the_epipolar_error_is_the_median_distance_from_epipolar_lines(cloud: np.ndarray) -> None:
    model, matches = scene([camera((0, 0, 0), (0, 0, 5)), camera((1, 0, 0), (1, 0, 5))], cloud)
    exact = median_epipolar_error(model, matches)
    assert exact is not None
    assert exact < 1e-9
    pair = matches.pairs[0]
    shifted = replace(matches, pairs=(replace(pair, second_pixels=pair.second_pixels + np.array([0, 2])),))
    longer = max(model.cameras[0].height, model.cameras[0].width)
    assert median_epipolar_error(model, shifted) == pytest.approx(2 / 2**0.5 / longer, rel=1e-6)
    assert median_epipolar_error(model, replace(matches, pairs=())) is None


def test_support_needs_points(cloud: np.ndarray) -> None:
    model, matches = scene(arc(4), cloud)
    bare = SparseModel(model.cameras, cloud[:10], {i: np.arange(10) for i in model.cameras})
    assert epipolar_support(bare, matches).score < 0.2 * epipolar_support(model, matches).score
    assert "only 10 points" in camera_warnings(bare, matches)[0]


def test_angle_of_a_right_triangle() -> None:
    cameras = [camera((0, 0, 0)), camera((1, 0, 0)), camera((0.5, 0, 0))]
    model, _ = scene(cameras, np.array([[0.0, 0.0, 1.0]]))
    assert median_angle(model) == pytest.approx(45)


def test_flatness(cloud: np.ndarray) -> None:
    model, _ = scene(arc(3), cloud)
    assert not is_flat(model)
    tilted = cloud @ np.array([[1, 0, 0.3], [0, 1, -0.2], [0, 0, 0]]) + [0, 0, 5]
    assert is_flat(replace(model, points=tilted))


@given(st.floats(1e-6, 1e6), st.integers(0, 100))
def test_the_frame_of_the_first_camera_undoes_any_similarity(scale: float, seed: int) -> None:
    points = np.random.default_rng(0).uniform([-1.5, -1, 4], [1.5, 1, 7], (40, 3))
    model, _ = scene(arc(3), points)
    generator = np.random.default_rng(seed)
    turn, _ = np.linalg.qr(generator.normal(size=(3, 3)))
    turn *= np.linalg.det(turn)
    shift = scale * generator.normal(size=3)
    cameras = {}
    for i, photo_camera in model.cameras.items():
        w2c = np.eye(4)
        w2c[:3, :3] = photo_camera.w2c[:3, :3] @ turn.T
        w2c[:3, 3] = scale * photo_camera.w2c[:3, 3] - w2c[:3, :3] @ shift
        cameras[i] = replace(photo_camera, w2c=w2c)
    moved = in_first_camera_frame(SparseModel(cameras, scale * points @ turn.T + shift, model.seen))
    expected = in_first_camera_frame(model)
    assert moved.points == pytest.approx(expected.points, abs=1e-9)
    for i in cameras:
        assert moved.cameras[i].w2c == pytest.approx(expected.cameras[i].w2c, abs=1e-9)
    assert np.array_equal(moved.cameras[0].w2c, np.eye(4))


@given(st.integers(1, 2000), st.integers(1, 2000))
def test_rescaled_keeps_the_corners(height: int, width: int) -> None:
    photo_camera = camera((0, 0, 0), size=(300, 400))
    small = rescaled(photo_camera, height, width)
    for x, y in ((0, 0), (400, 300)):
        before = (
            (x - photo_camera.principal[0]) / photo_camera.focal[0],
            (y - photo_camera.principal[1]) / photo_camera.focal[1],
        )
        corner = x * width / 400, y * height / 300
        after = (corner[0] - small.principal[0]) / small.focal[0], (corner[1] - small.principal[1]) / small.focal[1]
        assert after == pytest.approx(before)


@pytest.mark.parametrize("distortion", [(0.0, 0.0, 0.0, 0.0), (-0.2, 0.05, 0.0, 0.0), (0.15, 0.0, 0.002, -0.003)])
@pytest.mark.parametrize("max_size", [1000, 200])
def test_undistorted_pixels_are_where_the_pinhole_camera_sees_them(
    distortion: tuple[float, float, float, float], max_size: int
) -> None:
    """A picture whose colour is its own ray's direction, so that any half-pixel error shows."""
    photo_camera = camera((0, 0, 0), size=(300, 400), focal=380.0, distortion=distortion)
    v, u = np.mgrid[:300, :400] + 0.5
    ray = rays(np.stack([u.ravel(), v.ravel()], 1), photo_camera).reshape(300, 400, 2)
    encoded = np.concatenate([ray, ray[..., :1]], -1) * 150 + 127.5
    photo = Photo("ray.png", Path("ray.png"), np.round(encoded).astype(np.uint8))
    views, cameras = undistorted([photo], [photo_camera], max_size=max_size)
    height, width = views.sizes[0]
    assert max(height, width) == min(max_size, 400)
    assert views.masks[0].sum() == height * width
    K = cameras.K[0].double().numpy()
    v, u = np.mgrid[:height, :width] + 0.5
    expected = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]])
    found = (views.images[0, :2, :height, :width].double().numpy() * 255 - 127.5) / 150
    error = found - expected
    # Rounding to 8 bits scatters by ±0.5 / 150; half a pixel would shift the mean by 0.5 / 380.
    assert np.abs(error).max() < 0.01
    assert np.abs(error.mean((1, 2))).max() < 3e-4
    assert cameras.height % 12 == cameras.width % 12 == 0


def test_registry() -> None:
    assert isinstance(find_encoder("classical"), ClassicalEncoder)
    with pytest.raises(QuerySplatError, match="nonsense") as error:
        find_encoder("nonsense")
    assert "classical" in error.value.hint


def test_a_wrong_focal_length_is_warned_of(cloud: np.ndarray) -> None:
    model, matches = scene(arc(4), cloud)
    stated = replace(matches, focals=(600.0,) * 4)
    assert "focal length found differs by -49%" in camera_warnings(model, stated)[0]
    assert not camera_warnings(model, replace(matches, focals=(320.0,) * 4))


def test_points_behind_cameras_are_warned_of(cloud: np.ndarray) -> None:
    model, matches = scene(arc(4), cloud)
    behind = replace(model, points=np.concatenate([cloud[:250], -cloud[250:]]))
    assert any("behind" in warning for warning in camera_warnings(behind, matches))


def test_visibility_is_integer(cloud: np.ndarray) -> None:
    assert torch.from_numpy(scene(arc(2), cloud)[0].seen[0]).dtype == torch.int64


@given(st.lists(st.tuples(st.integers(0, 8), st.integers(0, 8)).filter(lambda ends: ends[0] < ends[1]), max_size=8))
def test_the_largest_group_is_connected_and_no_other_is_larger(ends: list[tuple[int, int]]) -> None:
    nothing = np.zeros((0, 2))
    pairs = tuple(Pair(*each, nothing, nothing) for each in ends)
    found = Matches(Path(), ((48, 64),) * 9, (None,) * 9, (), (0,) * 9, pairs).largest_group()
    groups = [{photo} for photo in range(9)]
    for each in ends:
        one, two = (next(group for group in groups if photo in group) for photo in each)
        groups = [one | two, *(group for group in groups if group not in (one, two))]
    largest = max(len(group) for group in groups)
    assert found == min(sorted(group) for group in groups if len(group) == largest)


@pytest.mark.parametrize("worse", [1.0, 1.1])
@pytest.mark.parametrize("photos", [CAMERA_POLICY.adjusted_photos, CAMERA_POLICY.adjusted_photos + 1])
def test_photos_outvote_the_focal_length_of_exif_where_they_are_many_or_fit_worse_with_it(
    photos: int, worse: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The photos say half of EXIF's focal length, and have `worse` times the error with that of EXIF."""
    camera = PhotoCamera(np.eye(4), (500.0, 500.0), (32.0, 24.0), (0.0, 0.0, 0.0, 0.0), 48, 64)
    found, pulled = (
        SparseModel(
            dict.fromkeys(range(photos), camera),
            np.array([[0.0, 0.0, 1.0]]),
            dict.fromkeys(range(photos), np.array([0])),
            dict.fromkeys(range(photos), np.array([[32.0 + error, 24.0]])),
        )
        for error in (0.5, 0.5 * worse)
    )
    monkeypatch.setattr(mapping, "centred", lambda reconstruction, **lenses: reconstruction)
    monkeypatch.setattr(mapping, "self_calibrated", lambda plain, fit_lens: plain)
    monkeypatch.setattr(mapping, "from_colmap", lambda reconstruction: found)
    monkeypatch.setattr(mapping, "bundle_adjusted", lambda *given: pulled)
    matches = Matches(Path(), ((48, 64),) * photos, (1000.0,) * photos, (), (0,) * photos, ())
    refined = Mapped(found, (), pycolmap.Reconstruction()).refined(matches)
    assert refined is (found if photos > CAMERA_POLICY.adjusted_photos or worse > 1 else pulled)
