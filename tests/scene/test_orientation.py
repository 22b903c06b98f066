"""Cameras for photos that are stored on their side or upside down."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
import torch
from PIL import ExifTags, Image
from scipy.spatial.transform import Rotation

from querysplat_cli.cli import run
from querysplat_cli.scene.cameras import PhotoCamera, rescaled
from querysplat_cli.scene.formats.colmap import read_colmap, write_colmap
from querysplat_cli.scene.formats.transforms import read_transforms, write_transforms
from querysplat_cli.scene.match_cameras import cameras_of_photos, match_cameras
from querysplat_cli.scene.orientation import upright_camera
from querysplat_cli.scene.photo_files import PhotoFile, write_photo_files
from querysplat_cli.scene.photos import load_photos
from querysplat_cli.scene.sparse_points import SparsePoints, write_sparse_points
from querysplat_cli.scene.views import Photo

HEIGHT, WIDTH = 120, 160
POSE = np.eye(4)
POSE[:3, :3], POSE[:3, 3] = Rotation.from_euler("xyz", [0.1, -0.2, 0.3]).as_matrix(), (0.1, 0.2, 0.3)
STORED = PhotoCamera(POSE, (150.0, 140.0), (75.0, 64.0), (0.1, -0.02, 0.01, -0.02), HEIGHT, WIDTH, as_stored=True)
READ = (read_colmap, "model"), (read_transforms, "t.json")


def photo(folder: Path, orientation: int) -> Photo:
    """A dark photo with one bright pixel at column 40, row 20 of the stored picture, and its EXIF orientation."""
    pixels = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    pixels[20, 40] = 255
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    Image.fromarray(pixels).save(folder / "a.png", exif=exif)
    ((found,), _) = load_photos([folder / "a.png"])
    return found


def pixel(camera: PhotoCamera, point: np.ndarray) -> np.ndarray:
    (fx, fy), (cx, cy) = camera.focal, camera.principal
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    turn, shift = cv2.Rodrigues(camera.w2c[:3, :3])[0], camera.w2c[:3, 3]
    return cv2.projectPoints(point[None], turn, shift, K, np.array(camera.distortion))[0].ravel()


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_a_point_is_seen_at_the_same_place_of_the_upright_picture(tmp_path: Path, orientation: int) -> None:
    seen = photo(tmp_path, orientation)
    ray = np.array([(40.5 - 75) / 150, (20.5 - 64) / 140, 1.0]) * 3
    point = (np.linalg.inv(POSE) @ [*ray, 1])[:3]
    bent = pixel(STORED, point)  # where the lens moves it to
    camera = upright_camera(STORED, seen)
    row, column = np.unravel_index(seen.pixels[..., 0].argmax(), seen.pixels.shape[:2])
    straight = PhotoCamera(camera.w2c, camera.focal, camera.principal, (0.0,) * 4, camera.height, camera.width)
    assert (camera.height, camera.width) == (seen.height, seen.width)
    assert pixel(straight, point) == pytest.approx([column + 0.5, row + 0.5], abs=1e-6)
    moved = np.linalg.norm(bent - (40.5, 20.5))
    assert np.linalg.norm(pixel(camera, point) - pixel(straight, point)) == pytest.approx(moved, abs=1e-6)
    back = {1: bent, 3: (WIDTH, HEIGHT) - bent, 6: (HEIGHT - bent[1], bent[0]), 8: (bent[1], WIDTH - bent[0])}
    assert pixel(camera, point) == pytest.approx(np.array(back[orientation]), abs=1e-6)


@pytest.mark.parametrize("orientation", [3, 6, 8])
def test_cameras_of_colmap_are_turned_with_their_photos(tmp_path: Path, orientation: int) -> None:
    seen = photo(tmp_path, orientation)
    (tmp_path / "model").mkdir()
    write_colmap(tmp_path / "model", {"a.png": STORED})
    (camera,) = cameras_of_photos([seen], read_colmap(tmp_path / "model")).values()
    assert camera.w2c[:3, :3] != pytest.approx(POSE[:3, :3])
    assert match_cameras([seen], {"a.png": camera})[1] == []


@pytest.mark.parametrize("orientation", [3, 6])
def test_a_json_of_a_model_is_for_stored_pixels_too(tmp_path: Path, orientation: int) -> None:
    """Its cameras of photos that were taken upside down were upside down."""
    seen = photo(tmp_path, orientation)
    (tmp_path / "model").mkdir()
    write_colmap(tmp_path / "model", {"a.png": STORED})
    assert run(["convert", str(tmp_path / "model"), str(tmp_path / "t.json"), "-q"]) == 0
    wanted, found = (cameras_of_photos([seen], read(tmp_path / place))["a.png"] for read, place in READ)
    assert found.w2c == pytest.approx(wanted.w2c)


def test_cameras_that_fit_the_upright_picture_stay(tmp_path: Path) -> None:
    upright = PhotoCamera(POSE, (150.0, 140.0), (60.0, 80.0), (0.0,) * 4, WIDTH, HEIGHT)
    for orientation in (6, 8):
        assert upright_camera(upright, photo(tmp_path, orientation)) is upright
    half_turn = photo(tmp_path, 3)
    known = PhotoCamera(POSE, (150.0, 140.0), (75.0, 64.0), (0.0,) * 4, HEIGHT, WIDTH)
    assert upright_camera(known, half_turn) is known


def test_a_mirrored_photo_has_no_camera_of_colmap(tmp_path: Path) -> None:
    (left_out,) = match_cameras([photo(tmp_path, 2)], {"a.png": STORED})[1]
    assert "mirrored: save it as it is shown" in left_out.why


def half_size(name: str, path: Path, camera: PhotoCamera) -> PhotoFile:
    half = rescaled(camera, camera.height // 2, camera.width // 2)
    return PhotoFile(name, path, half.focal, half.principal, half.distortion, half.height, half.width)


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_the_model_of_a_scene_is_for_its_photos_as_they_are_stored(tmp_path: Path, orientation: int) -> None:
    """Also where the scene is of photos that were reduced to half of their size."""
    seen = photo(tmp_path, orientation)
    camera = upright_camera(STORED, seen)
    (tmp_path / "s").mkdir()
    write_transforms(tmp_path / "s" / "cameras.json", {"a.png": camera})
    write_photo_files(tmp_path / "s" / "photos.json", [half_size("a.png", tmp_path / "a.png", camera)])
    row, column = np.unravel_index(seen.pixels[..., 0].argmax(), seen.pixels.shape[:2])
    places, colours = torch.tensor([[0.0, 0, 3]]), torch.zeros(1, 3, dtype=torch.uint8)
    view, point = torch.zeros(1, dtype=torch.int32), torch.zeros(1, dtype=torch.int32)
    pixels = torch.tensor([[column + 0.5, row + 0.5]], dtype=torch.float32) / 2
    write_sparse_points(tmp_path / "s", SparsePoints(places, colours, view, point, pixels))
    assert run(["convert", str(tmp_path / "s"), str(tmp_path / "model"), "-q"]) == 0
    made = read_colmap(tmp_path / "model")["a.png"]
    assert (made.height, made.width) == (HEIGHT, WIDTH)
    for name in ("w2c", "focal", "principal", "distortion"):
        assert getattr(made, name) == pytest.approx(getattr(STORED, name), abs=1e-9)
    ((observed,),) = (image.points2D for image in pycolmap.Reconstruction(tmp_path / "model").images.values())
    assert observed.xy == pytest.approx([40.5, 20.5])
    again = upright_camera(made, seen)
    assert again.w2c == pytest.approx(camera.w2c)


def test_a_scene_agrees_with_a_model_of_its_photos_as_they_are_stored(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also where only one of the photos was taken on its side."""
    given, upright, files = {}, {}, []
    (tmp_path / "s").mkdir()
    for number, orientation in enumerate((1, 6, 3)):
        name = f"{number}.png"
        seen = photo(tmp_path, orientation)
        (tmp_path / "a.png").rename(tmp_path / name)
        pose = POSE.copy()
        pose[:3, 3] = number, number**2, 1
        given[name] = replace(STORED, w2c=pose)
        upright[name] = upright_camera(given[name], seen)
        files.append(half_size(name, tmp_path / name, upright[name]))
    write_transforms(tmp_path / "s" / "cameras.json", upright)
    write_photo_files(tmp_path / "s" / "photos.json", files)
    (tmp_path / "model").mkdir()
    write_colmap(tmp_path / "model", given)
    for pair in (("s", "model"), ("model", "s/cameras.json")):
        assert run(["poses", *(str(tmp_path / each) for each in pair), "--json", "-q"]) == 0
        found = json.loads(capsys.readouterr().out)
        assert found["rotation_degrees"]["max"] == pytest.approx(0, abs=1e-3)
        assert found["focal_error"]["max_abs"] == pytest.approx(0, abs=1e-6)
