"""Cameras in files: axes, quirks of the formats, and our own cameras.json there and back."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import ExifTags, Image
from scipy.spatial.transform import Rotation

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.cameras import Cameras, PhotoCamera
from querysplat_cli.scene.formats.known import read_known_cameras
from querysplat_cli.scene.formats.transforms import (
    listed_paths,
    opengl_from_opencv,
    read_cameras,
    read_transforms,
    write_cameras,
    write_transforms,
)
from querysplat_cli.scene.formats.transforms_frame import opencv_from_opengl
from querysplat_cli.scene.views import Views

LENS = {"w": 640, "h": 480, "fl_x": 500.0, "fl_y": 510.0, "cx": 300.0, "cy": 250.0}


def frame(path: str = "images/1.png", matrix: Any = None, **lens: Any) -> dict[str, Any]:
    return {"file_path": path, "transform_matrix": np.eye(4).tolist() if matrix is None else matrix, **lens}


def write(path: Path, *frames: dict[str, Any], **common: Any) -> Path:
    path.write_text(json.dumps({**LENS, **common, "frames": list(frames)}))
    return path


def cameras(count: int, seed: int = 0) -> tuple[Cameras, Views]:
    generator = torch.Generator().manual_seed(seed)
    w2c = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    w2c[:, :3, :3] = torch.from_numpy(Rotation.random(count, random_state=seed).as_matrix())
    w2c[:, :3, 3] = torch.randn(count, 3, generator=generator, dtype=torch.float64) * 5
    K = torch.tensor([[400.0, 0, 150], [0, 390, 110], [0, 0, 1]]).repeat(count, 1, 1)
    K[:, 0, 0] += torch.rand(count, generator=generator)
    sizes = tuple((200 + i, 320 - i) for i in range(count))
    views = Views(
        torch.zeros(count, 3, 224, 320),
        torch.ones(count, 224, 320, dtype=torch.bool),
        tuple(f"sub/photo {i}.jpg" for i in range(count)),
        sizes,
    )
    return Cameras(w2c.float(), K, 224, 320), views


def test_axes_by_hand() -> None:
    """An OpenGL camera 2 m above the origin, looking along world -z (its own), sees y up, x right."""
    c2w = np.eye(4)
    c2w[:3, 3] = [0, 2, 0]
    w2c = opencv_from_opengl(c2w)
    ahead_and_low_right = np.array([1.0, 0, -3, 1])
    np.testing.assert_allclose(w2c @ ahead_and_low_right, [1, 2, 3, 1])
    np.testing.assert_allclose(opengl_from_opencv(w2c), c2w, atol=1e-15)


def test_what_is_written_is_read(tmp_path: Path) -> None:
    inputs, held = cameras(5), cameras(2, seed=1)
    write_cameras(tmp_path / "cameras.json", *inputs, heldout=(held[1], held[0]))
    for (written, views), back in zip((inputs, held), read_cameras(tmp_path / "cameras.json"), strict=True):
        assert back is not None
        assert (back.names, back.sizes) == (views.names, views.sizes)
        assert (back.cameras.height, back.cameras.width) == (224, 320)
        torch.testing.assert_close(back.cameras.w2c, written.w2c, rtol=0, atol=1e-6)
        torch.testing.assert_close(back.cameras.K, written.K, rtol=0, atol=0)


def test_our_file_is_in_nerfstudios_form(tmp_path: Path) -> None:
    written, views = cameras(2)
    write_cameras(tmp_path / "cameras.json", written, views)
    content = json.loads((tmp_path / "cameras.json").read_text())
    assert content["camera_model"] == "PINHOLE"
    first = content["frames"][0]
    assert first["file_path"] == "images/sub/photo 0.jpg"
    assert (first["w"], first["h"]) == (320, 200)
    centre = np.array(first["transform_matrix"])[:3, 3]
    np.testing.assert_allclose(centre, written.to(torch.float64).centres[0], atol=1e-5)
    assert read_cameras(tmp_path / "cameras.json")[1] is None
    assert list(read_transforms(tmp_path / "cameras.json")) == ["photo 0.jpg", "photo 1.jpg"]


def test_frames_may_have_their_own_lens(tmp_path: Path) -> None:
    path = write(tmp_path / "transforms.json", frame("a/1.png"), frame("a/2.png", fl_x=700.0, w=100, k1=0.1), k2=0.02)
    found = read_transforms(path)
    assert found["1.png"].focal == (500.0, 510.0)
    assert found["1.png"].distortion == (0.0, 0.02, 0.0, 0.0)
    assert found["2.png"].focal == (700.0, 510.0)
    assert found["2.png"].distortion == (0.1, 0.02, 0.0, 0.0)
    assert (found["2.png"].height, found["2.png"].width) == (480, 100)


def test_missing_centre_and_second_focal_length(tmp_path: Path) -> None:
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps({"w": 640, "h": 480, "fl_x": 500, "frames": [frame()]}))
    found = read_transforms(path)["1.png"]
    assert (found.focal, found.principal) == ((500.0, 500.0), (320.0, 240.0))


def test_angles_in_place_of_focal_lengths(tmp_path: Path) -> None:
    """Blender's exports state no fl_x, and were refused."""
    path = tmp_path / "transforms.json"
    angles = {"camera_angle_x": 2 * math.atan(640 / 2 / 500), "camera_angle_y": 2 * math.atan(480 / 2 / 510)}
    path.write_text(json.dumps({"w": 640, "h": 480, **angles, "frames": [frame()]}))
    assert read_transforms(path)["1.png"].focal == pytest.approx((500, 510))
    del angles["camera_angle_y"]
    path.write_text(json.dumps({"w": 640, "h": 480, **angles, "frames": [frame()]}))
    assert read_transforms(path)["1.png"].focal == pytest.approx((500, 500))
    path.write_text(json.dumps({"w": 640, "h": 480, "camera_angle_x": 0, "frames": [frame()]}))
    with pytest.raises(QuerySplatError, match=r"the camera of 1.png makes no sense"):
        read_transforms(path)


def test_the_size_of_the_picture_where_none_is_stated(tmp_path: Path) -> None:
    """Blender's and instant-ngp's files state an angle, and list pictures without their suffixes."""
    path = tmp_path / "transforms.json"
    angle = {"camera_angle_x": 2 * math.atan(64 / 2 / 50)}
    frames = [frame("./train/r_0"), frame("elsewhere/1.jpg"), frame(str(tmp_path / "2.png")), frame("3.png", h=48)]
    path.write_text(json.dumps({**angle, "frames": frames}))
    with pytest.raises(QuerySplatError, match="r_0 has no 'w'"):
        read_transforms(path)
    for name in ("train/r_0.png", "images/1.jpg", "2.png", "3.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        Image.new("RGB", (64, 48)).save(tmp_path / name)
    on_its_side = Image.Exif()
    on_its_side[ExifTags.Base.Orientation] = 6
    Image.new("RGB", (48, 64)).save(tmp_path / "images/1.jpg", exif=on_its_side)
    found = read_transforms(path)
    assert list(found) == ["r_0", "1.jpg", "2.png", "3.png"]
    for camera in found.values():
        assert (camera.width, camera.height) == (64, 48)
        assert camera.focal == pytest.approx((50, 50))
        assert camera.principal == (32, 24)
    (tmp_path / "2.png").write_bytes(b"no picture")
    with pytest.raises(QuerySplatError, match=r"2\.png has no 'w'"):
        read_transforms(path)


def test_frames_of_one_name_get_their_folder_in_the_name(tmp_path: Path) -> None:
    path = write(tmp_path / "transforms.json", frame("./left/1.png"), frame("./right/1.png"), frame("right/2.png"))
    assert list(read_transforms(path)) == ["left/1.png", "right/1.png", "2.png"]


def test_paths_may_have_been_written_on_windows(tmp_path: Path) -> None:
    path = write(tmp_path / "transforms.json", frame(r"images\a\1.png"), frame(r".\images\b\1.png"))
    assert list(read_transforms(path)) == ["a/1.png", "b/1.png"]
    assert list(listed_paths(path).values()) == ["images/a/1.png", "./images/b/1.png"]


def test_a_backslash_in_a_photos_name_is_kept(tmp_path: Path) -> None:
    given = PhotoCamera.pinhole(np.eye(4), np.diag([500.0, 500.0, 1.0]), 480, 640)
    write_transforms(tmp_path / "cameras.json", {r"a\b.png": given})
    assert list(read_transforms(tmp_path / "cameras.json")) == [r"a\b.png"]


def test_a_matrix_that_is_no_motion_is_left_to_the_encoder_but_not_rendered(tmp_path: Path) -> None:
    scaled, nan = (2 * np.eye(4)).tolist(), np.eye(4)
    nan[0, 3] = math.nan
    for bad in (scaled, nan.tolist()):
        path = write(tmp_path / "transforms.json", frame("good.png"), frame("bad.png", bad))
        assert list(read_transforms(path)) == ["good.png", "bad.png"]
        with pytest.raises(QuerySplatError, match=r"bad\.png"):
            read_cameras(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "cannot be read as JSON"),
        ("[]", "no cameras in it"),
        ('{"frames": []}', "no cameras in it"),
        ('{"frames": [1]}', "a frame has no file_path"),
        ('{"frames": [{"file_path": "1.png"}]}', "1.png has no 'w'"),
        ('{"w": 1, "h": 1, "fl_x": 1, "frames": [{"file_path": "1.png"}]}', "1.png has no 'transform_matrix'"),
        (json.dumps({**LENS, "frames": [frame(matrix=[[1, 2], [3, 4]])]}), "1.png makes no sense"),
        (json.dumps({**LENS, "frames": [frame(matrix=[["x"] * 4] * 4)]}), "1.png makes no sense"),
        (json.dumps({**LENS, "fl_x": -1, "frames": [frame()]}), "1.png makes no sense"),
        ("[" * 100_000, "nested too deeply"),
        ('{"w": 1' + "0" * 5000 + ', "frames": [{"file_path": "1.png"}]}', "cannot be read as JSON"),
        ('{"frames": [{"file_path": "\\ud800.png"}]}', "half a letter"),
        ('{"frames": [{"file_path": 7}]}', "7 is no name"),
        ('{"frames": [{"file_path": "."}]}', "no name"),
        ('{"frames": [{"file_path": ".."}]}', "no name"),
        ('{"frames": [{"file_path": "a/.."}]}', "no name"),
        ('{"frames": [{"file_path": "a\\u0000.png"}]}', "no name"),
        (json.dumps({**LENS, "frames": [frame()], "heldout_frames": {"a": 1}}), "heldout_frames"),
        *(
            (json.dumps({**LENS, key: value, "frames": [frame()]}), "1.png makes no sense")
            for key, values in {
                "w": (0, -111, 1e30, 1.5, math.nan, True, "640", 10**8),
                "fl_x": (0, -111, 1e-300, 1e30, math.nan, math.inf),
                "fl_y": (0, -111, 1e30),
                "cx": (math.nan, 1e30),
                "k1": (math.nan, math.inf, 1e30),
            }.items()
            for value in values
        ),
        (
            json.dumps({**LENS, "frames": [frame(matrix=[[1, 0, 0, 1e30], [0, 1, 0, 0], [0, 0, 1, 0]])]}),
            "makes no sense",
        ),
        (json.dumps({**LENS, "camera_model": "OPENCV_FISHEYE", "frames": [frame()]}), "lens of 1.png"),
        (json.dumps({**LENS, "k3": 0.1, "frames": [frame()]}), r"lens of 1.png .*\(OPENCV, k3 0\.1\)"),
    ],
)
def test_files_that_cannot_be_used_are_refused_with_the_reason(tmp_path: Path, content: str, message: str) -> None:
    path = tmp_path / "transforms.json"
    path.write_text(content)
    with pytest.raises(QuerySplatError, match=message):
        read_transforms(path)


@pytest.mark.parametrize("canvas", [[2, 2], 7, [480, "640"], [480.5, 640], [10**9, 10**9], [480]])
def test_a_canvas_that_cannot_hold_the_pictures_is_refused(tmp_path: Path, canvas: object) -> None:
    path = write(tmp_path / "cameras.json", frame(), canvas=canvas)
    with pytest.raises(QuerySplatError, match="canvas"):
        read_cameras(path)


def test_pictures_are_looked_for_in_their_own_folder_only(tmp_path: Path) -> None:
    """Whatever folders a file names, `render` writes, and the scene folder reads, below one folder."""
    path = write(
        tmp_path / "cameras.json", frame("../../etc/passwd"), frame("/images/b.png"), frame("./images/s/c.png")
    )
    assert read_cameras(path)[0].names == ("etc/passwd", "b.png", "s/c.png")


@pytest.mark.parametrize(
    "place",
    [lambda folder: folder, lambda folder: folder / "transforms.json"],
    ids=["folder", "file"],
)
def test_known_cameras_are_found(tmp_path: Path, place: Callable[[Path], Path]) -> None:
    write(tmp_path / "transforms.json", frame())
    assert list(read_known_cameras(place(tmp_path))) == ["1.png"]


def test_missing_known_cameras(tmp_path: Path) -> None:
    for path, message in ((tmp_path / "no", "no such file"), (tmp_path, "neither a transforms.json nor a COLMAP")):
        with pytest.raises(QuerySplatError, match=message):
            read_known_cameras(path)


def test_a_folder_of_splits_is_refused_with_their_names(tmp_path: Path) -> None:
    """As in NeRF's synthetic scenes, whose cameras are in a file for each split."""
    for split in ("test", "train"):
        (tmp_path / f"transforms_{split}.json").write_text("{}")
    with pytest.raises(QuerySplatError, match="neither") as caught:
        read_known_cameras(tmp_path)
    assert caught.value.hint == "Give one of its files: transforms_test.json, transforms_train.json."


def test_the_mark_that_windows_puts_before_a_text_is_no_damage(tmp_path: Path) -> None:
    write(tmp_path / "transforms.json", frame())
    content = (tmp_path / "transforms.json").read_bytes()
    (tmp_path / "transforms.json").write_bytes(b"\xef\xbb\xbf" + content)
    assert list(read_known_cameras(tmp_path)) == ["1.png"]


def test_dl3dv(real_photos: Path) -> None:
    """The cameras of a real capture all have one point in front of them."""
    found = read_known_cameras(real_photos / "dl3dv" / "fox")
    assert len(found) == 50
    w2c = np.stack([camera.w2c for camera in found.values()])
    centres = -np.einsum("vji,vj->vi", w2c[:, :3, :3], w2c[:, :3, 3])
    rays = w2c[:, 2, :3]
    across = np.eye(3) - rays[:, :, None] * rays[:, None]
    common = np.linalg.solve(across.sum(0), np.einsum("vij,vj->i", across, centres))
    assert ((common - centres) * rays).sum(1).min() > 0
