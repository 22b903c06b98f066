"""Camera paths: their course, their direction of view, and their smoothness."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.paths import halfway, interpolate, look_at, on_the_line, orbit

MIDDLE = torch.tensor([1.0, 2.0, 3.0])
UP = np.array([0.0, -1.0, 0.0])
CAMERA = Cameras(torch.eye(4)[None], torch.tensor([[[300.0, 0, 160], [0, 300, 120], [0, 0, 1]]]), 240, 320)


def ring(degrees: np.ndarray, radius: float = 4.0, height: float = 1.0) -> Cameras:
    """Cameras around MIDDLE, all looking at it, above it by `height` (the world's y points down)."""
    a = np.deg2rad(degrees)
    places = np.stack([radius * np.sin(a), np.full_like(a, -height), -radius * np.cos(a)], 1) + MIDDLE.numpy()
    return look_at(places, MIDDLE.double().numpy(), UP, CAMERA)


def azimuths(cameras: Cameras) -> np.ndarray:
    arm = (cameras.centres - MIDDLE).numpy()
    return np.rad2deg(np.arctan2(arm[:, 0], -arm[:, 2]))


def aim(cameras: Cameras) -> torch.Tensor:
    """Pixels at which MIDDLE appears."""
    local = cameras.w2c[:, :3, :3] @ MIDDLE + cameras.w2c[:, :3, 3]
    image = torch.einsum("vij,vj->vi", cameras.K, local)
    assert (local[:, 2] > 0).all()
    return image[:, :2] / image[:, 2:]


@pytest.mark.parametrize(
    ("degrees", "tilt"),
    # From one picture the tilt of the camera cannot be estimated.
    [(np.arange(0, 360, 30), 1e-5), (np.linspace(-25, 25, 9), 3e-3), (np.array([10.0]), 0.02)],
)
def test_an_orbit_looks_at_the_middle_from_the_usual_distance(degrees: np.ndarray, tilt: float) -> None:
    path = orbit(ring(degrees), MIDDLE, 60)
    torch.testing.assert_close(aim(path), torch.tensor([160.0, 120.0]).expand(60, 2), atol=1e-2, rtol=0)
    distance = (path.centres - MIDDLE).norm(dim=1)
    torch.testing.assert_close(distance, torch.full((60,), math.hypot(4, 1)), atol=1e-4, rtol=0)
    # The picture stands upright: the camera's y axis points down, its x axis is level.
    assert (path.w2c[:, 1, 1] > 0.5).all()
    assert path.w2c[:, 0, 1].abs().max() < tilt
    assert (path.height, path.width) == (240, 320)


def test_an_orbit_of_portrait_and_landscape_photos_has_its_middle_in_the_middle() -> None:
    inputs = ring(np.linspace(-25, 25, 8))
    inputs.K[::2, :2, 2] = torch.tensor([120.0, 160.0])  # every second photo is 240 wide and 320 high
    path = orbit(replace(inputs, height=240, width=320), MIDDLE, 12)
    torch.testing.assert_close(aim(path), torch.tensor([160.0, 120.0]).expand(12, 2), atol=1e-2, rtol=0)


def test_an_orbit_is_closed_and_smooth() -> None:
    for inputs in (ring(np.arange(0, 360, 30)), ring(np.linspace(-25, 25, 9))):
        centres = orbit(inputs, MIDDLE, 90).centres
        steps = (centres - centres.roll(1, 0)).norm(dim=1)
        assert steps.max() < 1.1 * 2 * math.pi * math.hypot(4, 1) / 90


def test_around_an_inward_ring_the_orbit_goes_around() -> None:
    found = np.sort(azimuths(orbit(ring(np.arange(0, 360, 30)), MIDDLE, 36)))
    np.testing.assert_allclose(np.diff(found), 10, atol=1e-2)


@pytest.mark.parametrize("towards", [0, 90, 180, 270])
def test_in_front_of_a_forward_facing_capture_the_orbit_stays_there(towards: float) -> None:
    """Also where the inputs' angles run through ±180°."""
    path = orbit(ring(towards + np.linspace(-25, 25, 9)), MIDDLE, 40)
    off = (azimuths(path) - towards + 180) % 360 - 180
    assert np.abs(off).max() == pytest.approx(0.8 * 25, abs=0.5)


def test_cameras_in_the_middle_are_refused() -> None:
    with pytest.raises(QuerySplatError, match="at the point to look at"):
        orbit(CAMERA, torch.zeros(3), 10)


def test_interpolation_passes_through_its_inputs() -> None:
    inputs = ring(np.array([0.0, 20, 50, 60]))
    path = interpolate(inputs, 31)
    torch.testing.assert_close(path.w2c[::10], inputs.w2c, atol=1e-5, rtol=0)
    rotation = path.w2c[:, :3, :3]
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3).expand(31, 3, 3), atol=1e-5, rtol=0)
    assert (np.diff(azimuths(path)) > 0).all()


def test_interpolation_turns_the_short_way_at_a_constant_rate() -> None:
    w2c = torch.eye(4).repeat(2, 1, 1)
    w2c[0, :3, :3] = torch.from_numpy(Rotation.from_euler("y", 170, degrees=True).as_matrix())
    w2c[1, :3, :3] = torch.from_numpy(Rotation.from_euler("y", -170, degrees=True).as_matrix())
    path = interpolate(Cameras(w2c, CAMERA.K.repeat(2, 1, 1), 240, 320), 5)
    angles = Rotation.from_matrix(path.w2c[:, :3, :3].numpy()).as_euler("yxz", degrees=True)[:, 0] % 360
    np.testing.assert_allclose(angles, [170, 175, 180, 185, 190], atol=1e-3)


@pytest.mark.parametrize("degrees", [0.0, 1e-7, 180.0])
def test_interpolation_between_equal_and_opposite_cameras_is_finite(degrees: float) -> None:
    w2c = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    w2c[1, :3, :3] = torch.from_numpy(Rotation.from_euler("y", degrees, degrees=True).as_matrix())
    path = interpolate(Cameras(w2c, CAMERA.K.repeat(2, 1, 1).double(), 240, 320), 7)
    assert torch.isfinite(path.w2c).all()
    torch.testing.assert_close(path.w2c[[0, -1]], w2c)


def test_interpolation_of_one_camera_repeats_it() -> None:
    assert interpolate(CAMERA, 3).w2c.shape == (3, 4, 4)


def test_halfway_places_are_between_neighbours_in_any_order() -> None:
    """Photos of both sides of an object: the middle between the sides lies in it."""
    degrees = np.array([0.0, 10, 25, 180, 192])
    places = halfway(ring(degrees)).centres
    np.testing.assert_allclose(azimuths(halfway(ring(degrees))), [5, 17.5, -174], atol=1e-3)
    shuffled = halfway(ring(degrees[[3, 0, 4, 2, 1]])).centres
    assert torch.cdist(places, shuffled).min(1).values.max() < 1e-3
    assert len(halfway(ring(degrees[:1]))) == 1


def test_a_line_goes_on_beyond_both_cameras() -> None:
    w2c = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    w2c[1, :3, :3] = torch.from_numpy(Rotation.from_euler("y", 20, degrees=True).as_matrix())
    pair = Cameras(w2c, CAMERA.K.repeat(2, 1, 1).double(), 240, 320)
    for share, angle in ((-0.5, -10), (0.0, 0), (0.5, 10), (1.0, 20), (1.5, 30)):
        rotation = Rotation.from_matrix(on_the_line(pair, share).w2c[0, :3, :3].numpy())
        np.testing.assert_allclose(rotation.as_euler("yxz", degrees=True), [angle, 0, 0], atol=1e-6)
    sideways = ring(np.array([0.0, 40]))
    beyond = on_the_line(sideways, 1.5).centres[0]
    torch.testing.assert_close(beyond, 1.5 * sideways.centres[1] - 0.5 * sideways.centres[0])
