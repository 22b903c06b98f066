"""Fisheye photos and panoramas become pinhole views, in the right directions."""

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from PIL import Image

from querysplat_cli.commands.convert import convert
from querysplat_cli.commands.convert_request import Conversion
from querysplat_cli.pipeline.kept_parts import read_part, write_part
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.filed_pixels import FiledPixels
from querysplat_cli.scene.formats.known import read_known_cameras
from querysplat_cli.scene.formats.transforms import write_transforms
from querysplat_cli.scene.lenses import pinhole_photos, same_panorama
from querysplat_cli.scene.photo_files import photo_files, read_photo_files, write_photo_files
from querysplat_cli.scene.photos import load_photos
from querysplat_cli.scene.resample import FACE_FIELD, FACES, fisheye_view, panorama_views
from querysplat_cli.scene.views import Photo

HEIGHT, WIDTH = 240, 320
LENS = (110.0, 112.0, 158.0, 121.0)
BENT = (0.02, -0.004, 0.001, -0.0002)


def fisheye(w2c: np.ndarray | None = None) -> PhotoCamera:
    pose = np.eye(4) if w2c is None else w2c
    return PhotoCamera(pose, LENS[:2], LENS[2:], BENT, HEIGHT, WIDTH, fisheye=True)


def places(height: int, width: int) -> np.ndarray:
    """A picture whose colours are the places of its pixels: x, y."""
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.dstack([x, y]).astype(np.float32)


def rays(photo_width: int, view_height: int, view_width: int, focal: tuple[float, float]) -> np.ndarray:
    """Directions [height, width, 3] of the pixels of a view whose principal point is its middle."""
    x, y = np.moveaxis(places(view_height, view_width), -1, 0)
    fx, fy = focal[0] * photo_width, focal[1] * photo_width
    return np.dstack([(x - view_width / 2) / fx, (y - view_height / 2) / fy, np.ones_like(x)]).astype(np.float64)


def test_a_fisheye_view_is_what_opencv_says() -> None:
    view = fisheye_view(LENS, BENT, HEIGHT, WIDTH)
    found = view.picture(places(HEIGHT, WIDTH))
    directions = rays(WIDTH, *found.shape[:2], view.focal).reshape(-1, 1, 3)
    K = np.array([[LENS[0], 0, LENS[2]], [0, LENS[1], LENS[3]], [0, 0, 1]])
    expected, _ = cv2.fisheye.projectPoints(directions, np.zeros(3), np.zeros(3), K, np.array(BENT))
    inside = np.abs(found.reshape(-1, 2) - expected[:, 0])
    assert inside.max() < 0.6  # rounding of the view's size to whole pixels
    assert inside.mean() < 0.3
    assert abs(found.shape[1] / found.shape[0] - WIDTH / HEIGHT) < 0.02
    corner = np.hypot(view.size[1] / view.focal[0], view.size[0] / view.focal[1]) / 2
    assert np.degrees(np.arctan(corner)) == pytest.approx(60, abs=0.5)


def test_a_fisheye_view_holds_at_any_size() -> None:
    view = fisheye_view(LENS, BENT, HEIGHT, WIDTH)
    half = view.picture(places(HEIGHT // 2, WIDTH // 2))
    whole = cv2.resize(view.picture(places(HEIGHT, WIDTH)), half.shape[1::-1], interpolation=cv2.INTER_AREA)
    assert np.abs(2 * half - whole)[2:-2, 2:-2].max() < 1.5


def test_a_lens_that_folds_the_picture_is_refused() -> None:
    with pytest.raises(QuerySplatError, match="fold the picture"):
        fisheye_view(LENS, (-0.9, 0.0, 0.0, 0.0), HEIGHT, WIDTH)


def test_the_views_of_a_panorama_look_around() -> None:
    height, width = 256, 512
    middles = []
    for view in panorama_views():
        found = view.picture(places(height, width))
        directions = rays(width, *found.shape[:2], view.focal) @ np.array(view.rotation).reshape(3, 3).T
        x, y, z = np.moveaxis(directions, -1, 0)
        longitude, latitude = np.arctan2(x, z), np.arcsin(-y / np.linalg.norm(directions, axis=-1))
        expected = np.dstack([(longitude / (2 * np.pi) + 0.5) * width, (0.5 - latitude / np.pi) * height])
        away = np.abs(found - expected)
        # Beside the seam, and at the poles, neighbouring pixels have places far apart.
        smooth = (expected[..., 0] > 4) & (expected[..., 0] < width - 4) & (np.abs(latitude) < 1.4)
        assert away[smooth].max() < 0.6
        middles.append(found[found.shape[0] // 2, found.shape[1] // 2])
    for (yaw, lift), middle in zip(FACES[:6], middles[:6], strict=True):
        assert abs((middle[0] / width * 360 - 180 - yaw + 180) % 360 - 180) < 2
        assert abs(90 - middle[1] / height * 180 - lift) < 2
    assert middles[6][1] < 4 < height - 4 < middles[7][1]  # up, then down


def test_the_views_of_a_panorama_cover_everything() -> None:
    directions = np.random.default_rng(0).normal(size=(5000, 3))
    seen = np.zeros(len(directions), bool)
    for view in panorama_views():
        x, y, z = (directions @ np.array(view.rotation).reshape(3, 3)).T
        reach = z * np.tan(np.radians(FACE_FIELD / 2))
        seen |= (z > 0) & (np.abs(x) <= reach) & (np.abs(y) <= reach)
    assert seen.all()


def test_known_fisheye_cameras_become_pinholes(tmp_path: Path) -> None:
    pose = np.eye(4)
    pose[:3, 3] = 1, 2, 3
    pixels = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    mask = np.ones((HEIGHT, WIDTH), bool)
    mask[:, :100] = False
    photo = Photo("a.png", tmp_path / "a.png", pixels, mask=mask)
    (found,), cameras = pinhole_photos([photo], {"a.png": fisheye(pose)}, "auto")
    assert cameras is not None
    camera = cameras["a.png"]
    assert (camera.height, camera.width) == (found.height, found.width)
    assert not camera.fisheye
    assert not any(camera.distortion)
    np.testing.assert_array_equal(camera.w2c, pose)
    assert abs(camera.focal[0] - LENS[0]) < 0.5
    assert found.mask is not None
    assert 0.5 < found.mask.mean() < 0.95
    (same,), _ = pinhole_photos([photo], None, "auto")
    assert same is photo


def test_a_view_is_found_again_and_larger(tmp_path: Path) -> None:
    """photos.json keeps the view; the file may hold more pixels than the photo that the scene was made of."""
    pixels = np.random.default_rng(1).integers(0, 255, (30, 40, 3), dtype=np.uint8)
    large = cv2.resize(pixels, (2 * WIDTH, 2 * HEIGHT), interpolation=cv2.INTER_CUBIC)
    Image.fromarray(large).save(tmp_path / "a.png")
    (photo,), _ = load_photos([tmp_path / "a.png"], WIDTH)
    (straight,), cameras = pinhole_photos([photo], {"a.png": fisheye()}, "auto")
    assert cameras is not None
    files = photo_files(["a.png"], [cameras["a.png"]], {"a.png": straight.source})
    write_photo_files(tmp_path / "photos.json", files)
    file = read_photo_files(tmp_path / "photos.json")["a.png"]
    assert file == files[0]
    _, width = file.full_size()
    assert abs(width - 2 * straight.width) <= 2
    again = file.load(width)
    assert abs(again.width - width) <= 2
    small = cv2.resize(again.pixels, (straight.width, straight.height), interpolation=cv2.INTER_AREA)
    assert np.abs(small.astype(int) - straight.pixels).mean() < 6
    listing = json.loads((tmp_path / "photos.json").read_text())
    listing["photos"][0]["view"]["size"] = [1e9, 1.0]
    (tmp_path / "photos.json").write_text(json.dumps(listing))
    with pytest.raises(QuerySplatError, match="makes no sense"):
        read_photo_files(tmp_path / "photos.json")


def test_panoramas_by_option_and_by_xmp(tmp_path: Path) -> None:
    pixels = np.zeros((128, 256, 3), np.uint8)
    packet = b'<rdf:Description GPano:ProjectionType="equirectangular"/>'
    Image.fromarray(pixels).save(tmp_path / "says.jpg", xmp=packet)
    Image.fromarray(pixels).save(tmp_path / "silent.jpg")
    photos, _ = load_photos([tmp_path / "says.jpg", tmp_path / "silent.jpg"])
    assert [photo.panorama for photo in photos] == [True, False]
    auto, _ = pinhole_photos(photos, None, "auto")
    assert [photo.name for photo in auto] == [*(f"says_{n}.jpg" for n in range(8)), "silent.jpg"]
    assert all(photo.focal and photo.height == photo.width == 97 for photo in auto[:8])
    assert same_panorama(auto[0], auto[5])
    every, _ = pinhole_photos(photos, None, "equirectangular")
    assert len(every) == 16
    assert not same_panorama(every[0], every[8])


@pytest.mark.parametrize("entry", [b'GPano:%s="%d"', b"<GPano:%s>%d</GPano:%s>"], ids=["attributes", "elements"])
def test_a_part_of_a_panorama_is_an_ordinary_photo(tmp_path: Path, entry: bytes) -> None:
    for name, part in (("whole", 256), ("part", 200)):
        sizes = {b"CroppedAreaImageWidthPixels": part, b"FullPanoWidthPixels": 256}
        stated = [entry % (key, size, *[key] * (entry.count(b"%") - 2)) for key, size in sizes.items()]
        packet = b'<x GPano:ProjectionType="equirectangular" ' + b" ".join(stated) + b">"
        Image.fromarray(np.zeros((128, 256, 3), np.uint8)).save(tmp_path / f"{name}.jpg", xmp=packet)
    photos, _ = load_photos([tmp_path / "whole.jpg", tmp_path / "part.jpg"])
    assert [photo.panorama for photo in photos] == [True, False]
    Image.fromarray(np.zeros((128, 512, 3), np.uint8)).save(tmp_path / "part.jpg", xmp=packet)
    photos, _ = load_photos([tmp_path / "part.jpg"])
    assert [photo.name for photo in pinhole_photos(photos, None, "auto")[0]] == ["part.jpg"]


def test_a_view_of_a_panorama_with_the_name_of_a_photo_is_refused(tmp_path: Path) -> None:
    panorama = Photo("a.png", tmp_path / "a.png", np.zeros((64, 128, 3), np.uint8), panorama=True)
    photo = Photo("a_0.png", tmp_path / "a_0.png", np.zeros((48, 64, 3), np.uint8))
    with pytest.raises(QuerySplatError, match=r"a_0\.png is the name of a photo"):
        pinhole_photos([panorama, photo], None, "auto")


def test_views_of_panoramas_are_kept_like_photos(tmp_path: Path) -> None:
    """In the file where memory ends, and in tasks of regions."""
    panorama = Photo("a.png", tmp_path / "a.png", np.zeros((64, 128, 3), np.uint8), panorama=True)
    views, _ = pinhole_photos([panorama], None, "auto", FiledPixels(tmp_path, 0))
    assert all(isinstance(view.pixels, np.memmap) for view in views)
    view = views[3].view
    write_part(tmp_path / "view.pt", view)
    assert read_part(tmp_path / "view.pt") == view


def test_what_is_no_panorama_is_refused(tmp_path: Path) -> None:
    photo = Photo("a.png", tmp_path, np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    with pytest.raises(QuerySplatError, match="twice as wide as high"):
        pinhole_photos([photo], None, "equirectangular")
    wide = replace(photo, pixels=np.zeros((100, 200, 3), np.uint8), panorama=True)
    with pytest.raises(QuerySplatError, match="camera is estimated"):
        pinhole_photos([wide], {}, "auto")


@pytest.mark.parametrize("model", ["OPENCV_FISHEYE", "RADIAL_FISHEYE"])
def test_fisheye_cameras_of_colmap(tmp_path: Path, model: str) -> None:
    params = [*LENS, *BENT] if model == "OPENCV_FISHEYE" else [110.0, 158.0, 121.0, *BENT[:2]]
    reconstruction = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=params, camera_id=1)
    reconstruction.add_camera_with_trivial_rig(camera)
    image = pycolmap.Image(name="a.png", camera_id=1, image_id=1)
    reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d(np.eye(4)[:3]))
    reconstruction.write_binary(tmp_path)
    with pytest.raises(QuerySplatError, match="lens model"):
        read_known_cameras(tmp_path)
    found = read_known_cameras(tmp_path, fisheye=True)["a.png"]
    assert found.fisheye
    assert found.distortion == pytest.approx((*BENT[:2], 0.0, 0.0) if model == "RADIAL_FISHEYE" else BENT)


def test_fisheye_cameras_of_nerfstudio(tmp_path: Path) -> None:
    keys = dict(zip(("fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4"), (*LENS, *BENT), strict=True))
    frame = {"file_path": "images/a.png", "transform_matrix": np.eye(4).tolist()}
    content = {"camera_model": "OPENCV_FISHEYE", "w": WIDTH, "h": HEIGHT, **keys, "frames": [frame]}
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(QuerySplatError, match=r"lens of a\.png"):
        read_known_cameras(tmp_path)
    found = read_known_cameras(tmp_path, fisheye=True)["a.png"]
    assert found.fisheye
    assert found.distortion == BENT


@pytest.mark.parametrize("mixed", [False, True])
def test_fisheye_cameras_are_converted(tmp_path: Path, mixed: bool) -> None:
    """transforms.json → COLMAP → COLMAP text → transforms.json → scene folder of pinhole views."""
    photos, stations = tmp_path / "photos", [tmp_path / name for name in ("a.json", "model", "text", "b.json")]
    photos.mkdir()
    Image.new("RGB", (WIDTH, HEIGHT), "red").save(photos / "a.png")
    given = {"a.png": fisheye(), **({"b.png": replace(fisheye(), fisheye=False)} if mixed else {})}
    write_transforms(stations[0], given)
    for source, target in pairwise(stations):
        convert(Conversion(source, target, text=target.name == "text"))
    for station in stations:
        found = read_known_cameras(station, fisheye=True)
        assert found.keys() == given.keys()
        for name, camera in given.items():
            assert found[name].fisheye == camera.fisheye
            assert found[name].focal == pytest.approx(camera.focal)
            assert found[name].distortion == pytest.approx(camera.distortion)
    made = convert(Conversion(stations[-1], tmp_path / "scene", photos=photos))
    assert made["cameras"] == 1
    camera = read_known_cameras(tmp_path / "scene")["a.png"]
    assert camera.distortion == (0, 0, 0, 0)
    assert camera.focal[0] == pytest.approx(LENS[0], abs=0.5)
