"""Known cameras: poses that another tool has found."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
import torch
from synthetic import arc, photograph, photographs, room

from querysplat_cli.encoders.base import CameraRequest, PosedViews
from querysplat_cli.encoders.classical.cameras import estimate_cameras
from querysplat_cli.runtime.errors import ImpossibleScene
from querysplat_cli.scene.cameras import PhotoCamera, rescaled
from querysplat_cli.scene.views import Photo

CAMERAS = arc(4, distortion=(-0.1, 0.02, 0.001, -0.001))


@pytest.fixture(scope="module")
def photos() -> list[Photo]:
    return photographs(room(), CAMERAS)


def place(photos: list[Photo], known: Mapping[str, PhotoCamera]) -> PosedViews:
    return estimate_cameras(photos, CameraRequest(256, 0, known), lambda text, fraction: None)


def given(cameras: list[PhotoCamera]) -> dict[str, PhotoCamera]:
    return {f"{i}.png": camera for i, camera in enumerate(cameras)}


@pytest.fixture(scope="module")
def posed(photos: list[Photo]) -> PosedViews:
    return place(photos, given(CAMERAS))


def test_poses_are_kept_up_to_origin_and_scale(posed: PosedViews) -> None:
    origin = np.linalg.inv(CAMERAS[0].w2c)
    expected = np.stack([camera.w2c @ origin for camera in CAMERAS])
    found = posed.cameras.w2c.double().numpy()
    assert found[:, :3, :3] == pytest.approx(expected[:, :3, :3], abs=1e-6)
    scale = np.linalg.norm(found[3, :3, 3]) / np.linalg.norm(expected[3, :3, 3])
    assert found[:, :3, 3] == pytest.approx(scale * expected[:, :3, 3], abs=1e-6)
    assert torch.equal(posed.cameras.w2c[0], torch.eye(4))
    assert not posed.warnings


def test_points_are_where_the_room_is(posed: PosedViews) -> None:
    origin = np.linalg.inv(CAMERAS[0].w2c)
    scale = posed.cameras.centres[3].norm().item() / np.linalg.norm(
        (CAMERAS[3].w2c @ origin)[:3, :3].T @ (CAMERAS[3].w2c @ origin)[:3, 3]
    )
    world = posed.points.double().numpy() / scale @ origin[:3, :3].T + origin[:3, 3]
    assert len(world) > 300
    surfaces = np.stack([np.abs((world - plane.corner) @ _normal(plane.across, plane.down)) for plane in room()], 1)
    assert np.median(surfaces.min(1)) < 0.01


def _normal(across: tuple[float, ...], down: tuple[float, ...]) -> np.ndarray:
    normal = np.cross(across, down)
    return normal / np.linalg.norm(normal)


def test_the_views_are_those_of_pinhole_cameras(posed: PosedViews) -> None:
    for view, camera in enumerate(CAMERAS):
        K, (height, width) = posed.cameras.K[view].tolist(), posed.views.sizes[view]
        straight = PhotoCamera(camera.w2c, (K[0][0], K[1][1]), (K[0][2], K[1][2]), (0.0,) * 4, height, width)
        expected = torch.from_numpy(photograph(room(), straight, "").pixels).permute(2, 0, 1) / 255
        difference = (posed.views.images[view][:, :height, :width] - expected).abs()
        assert float(difference.median()) < 0.02
        assert float(difference.quantile(0.9)) < 0.06


def test_cameras_of_photos_at_another_size(photos: list[Photo], posed: PosedViews) -> None:
    found = place(photos, given([rescaled(camera, 960, 1280) for camera in CAMERAS]))
    assert found.cameras.K.numpy() == pytest.approx(posed.cameras.K.numpy(), rel=1e-5)
    assert not found.warnings


def test_photos_without_a_usable_camera_are_named(photos: list[Photo]) -> None:
    known = given(CAMERAS)
    del known["0.png"]
    known["1.png"] = replace(CAMERAS[1], height=400, width=300)
    known["2.png"] = replace(CAMERAS[2], w2c=CAMERAS[2].w2c @ np.diag([1, 1, -1, 1]))
    found = place(photos, known)
    assert found.views.names == ("3.png",)
    assert [left.name for left in found.left_out] == ["0.png", "1.png", "2.png"]
    whys = [left.why for left in found.left_out]
    assert "no camera" in whys[0]
    assert "300 × 400" in whys[1]
    assert "rigid" in whys[2]
    assert len(found.points) == 0


def test_a_photo_of_which_the_mask_leaves_no_pixel(photos: list[Photo]) -> None:
    """Known cameras place it, whatever it shows. It had a score of NaN, and so had the whole scene."""
    line = np.zeros(photos[0].pixels.shape[:2], bool)
    line[100] = True
    found = place([replace(photos[0], mask=line), *photos[1:]], given(CAMERAS))
    assert [(each.name, each.why) for each in found.left_out] == [
        ("0.png", "its mask hides all of it at the working size")
    ]
    assert found.views.names == ("1.png", "2.png", "3.png")
    with pytest.raises(ImpossibleScene, match=r"the mask of 0\.png hides all of it"):
        place([replace(photo, mask=line) for photo in photos], given(CAMERAS))


def test_names_that_do_not_match(photos: list[Photo]) -> None:
    with pytest.raises(ImpossibleScene, match="none of the 4 photos"):
        place(photos, {"a.png": CAMERAS[0]})


def test_wrong_cameras_raise_a_warning(photos: list[Photo]) -> None:
    found = place(photos, given([CAMERAS[i] for i in (2, 0, 3, 1)]))
    assert any("agree with the cameras" in warning for warning in found.warnings)
