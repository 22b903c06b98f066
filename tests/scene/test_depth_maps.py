"""Depth maps: which file belongs to a photo, what is read of it, and what a view sees of it."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.depth_maps import depth_of_photo, depth_of_view, with_depth_maps
from querysplat_cli.scene.formats.transforms import read_transforms
from querysplat_cli.scene.photos import load_photos
from querysplat_cli.scene.views import Photo, PhotoSource

SIZE = (96, 128)
SLOPE = np.linspace(1000, 3000, 24 * 32).reshape(24, 32)


def photo(folder: Path, name: str = "a.jpg", **options: object) -> Photo:
    pixels = np.random.default_rng(0).integers(0, 256, (*SIZE, 3), np.uint8)
    Image.fromarray(pixels).save(folder / name, **options)
    (found,), _ = load_photos([folder / name])
    return found


def write(path: Path, depth: np.ndarray) -> Path:
    path.parent.mkdir(exist_ok=True)
    if path.suffix == ".npy":
        np.save(path, depth)
    elif path.suffix == ".bin":
        path.write_bytes(b"%d&%d&1&" % depth.shape[::-1] + depth.astype("<f4").tobytes())
    else:
        assert cv2.imwrite(str(path), depth)
    return path


@pytest.mark.parametrize(
    ("name", "stored"),
    [
        ("a.png", SLOPE.astype(np.uint16)),
        ("a.jpg.png", SLOPE.astype(np.uint16)),
        ("a_depth.npy", SLOPE),
        ("a.npy", SLOPE.astype(np.float32)[..., None]),
        ("a.tif", SLOPE.astype(np.float32)),
        ("a.jpg.geometric.bin", SLOPE),
        ("a.jpg.photometric.bin", SLOPE),
    ],
)
def test_a_map_is_found_by_its_photos_name_and_whole_numbers_are_millimetres(
    tmp_path: Path, name: str, stored: np.ndarray
) -> None:
    file = write(tmp_path / "maps" / name, stored)
    (found,) = with_depth_maps([photo(tmp_path)], tmp_path / "maps", {})
    assert found.depth_map == found.source.depth_map == file
    metres = SLOPE / 1000 if stored.dtype.kind == "u" else SLOPE
    np.testing.assert_allclose(depth_of_photo(file, found.source, SIZE), metres, rtol=1.1e-3)


def photos_of_one_name(folder: Path) -> list[Photo]:
    for name in "ab":
        (folder / name).mkdir()
        photo(folder / name, "1.png")
    return load_photos([folder / "a" / "1.png", folder / "b" / "1.png"])[0]


@pytest.mark.parametrize("mirrored", ["", "photos"])
def test_photos_of_one_name_have_the_maps_of_their_folders(tmp_path: Path, mirrored: str) -> None:
    """Whether the folder of maps mirrors that of the photos, or the one around it. A map beside is neither's."""
    (tmp_path / "photos").mkdir()
    photos = photos_of_one_name(tmp_path / "photos")
    write(tmp_path / "maps" / "1.npy", SLOPE)
    (tmp_path / "maps" / mirrored).mkdir(exist_ok=True)
    files = [write(tmp_path / "maps" / mirrored / name / "1.npy", SLOPE) for name in "ab"]
    assert [found.depth_map for found in with_depth_maps(photos, tmp_path / "maps", {})] == files


def test_a_map_that_may_be_that_of_two_photos_is_refused(tmp_path: Path) -> None:
    photos = photos_of_one_name(tmp_path)
    write(tmp_path / "maps" / "1.npy", SLOPE)
    with pytest.raises(QuerySplatError, match=r"maps: 1.npy may belong to a/1.png or to b/1.png"):
        with_depth_maps(photos, tmp_path / "maps", {})


def test_a_photo_is_no_map_of_itself(tmp_path: Path) -> None:
    found = photo(tmp_path, "a.png")
    file = write(tmp_path / "a.tif", SLOPE.astype(np.float32))
    assert [each.depth_map for each in with_depth_maps([found], tmp_path, {})] == [file]


def test_of_colmaps_two_maps_the_geometric_one_counts(tmp_path: Path) -> None:
    for kind in ("photometric", "geometric"):
        write(tmp_path / "maps" / f"a.jpg.{kind}.bin", SLOPE)
    (found,) = with_depth_maps([photo(tmp_path)], tmp_path / "maps", {})
    assert found.depth_map == tmp_path / "maps" / "a.jpg.geometric.bin"


@pytest.mark.parametrize("name", ["a.npy", "a.jpg.geometric.bin"])
def test_what_is_no_distance_is_unknown(tmp_path: Path, name: str) -> None:
    stored = SLOPE.copy()
    stored[0, :4] = [np.nan, np.inf, -2, 0]
    found = depth_of_photo(write(tmp_path / name, stored), PhotoSource(tmp_path / "a.jpg"), SIZE)
    assert found[0, :4].tolist() == [0, 0, 0, 0]
    assert (found > 0).sum() == stored.size - 4


@pytest.mark.parametrize(
    ("name", "stored", "said"),
    [
        ("a.png", np.zeros((24, 32), np.uint8), "no depth map (24 × 32 of uint8)"),
        ("a.png", np.zeros((24, 32, 3), np.uint16), "no depth map (24 × 32 × 3 of uint16)"),
        ("a.npy", np.zeros((32, 24)), "24 × 32 pixels, another shape than a.jpg"),
        ("a.npy", np.array([[{}]]), "cannot be read"),
        ("b.npy", SLOPE, "no map of any of the 1 photos in it"),
    ],
)
def test_what_is_no_map_of_the_photo_is_refused(tmp_path: Path, name: str, stored: np.ndarray, said: str) -> None:
    write(tmp_path / "maps" / name, stored)
    with pytest.raises(QuerySplatError) as refusal:
        with_depth_maps([photo(tmp_path)], tmp_path / "maps", {})
    assert said in str(refusal.value)


def test_damaged_files_and_missing_folders_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"\x89PNG")
    (tmp_path / "a.npy").write_bytes(b"\x93NUMPY")
    for file in (tmp_path / "a.png", tmp_path / "a.npy"):
        with pytest.raises(QuerySplatError, match="cannot be read"):
            depth_of_photo(file, PhotoSource(tmp_path / "a.jpg"), SIZE)
    with pytest.raises(QuerySplatError, match="no such folder"):
        with_depth_maps([photo(tmp_path)], tmp_path / "none", {})


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"32&24&1&",
        b"32&24&1&" + bytes(4 * 32 * 24 - 1),
        b"32&24&1&" + bytes(4 * 32 * 24 - 4),
        b"32&24&3&" + bytes(4 * 32 * 24),
        b"-32&-24&1&" + bytes(4 * 32 * 24),
        b"x&24&1&" + bytes(4 * 32 * 24),
        b"0&24&1&",
        b"9" * 5000 + b"&24&1&" + bytes(4 * 24),
    ],
)
def test_damaged_maps_of_colmap_are_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.jpg.geometric.bin").write_bytes(content)
    with pytest.raises(QuerySplatError, match="cannot be read"):
        with_depth_maps([photo(tmp_path)], tmp_path, {})


def test_a_map_of_the_stored_pixels_is_turned_with_the_photo(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6  # the stored picture is turned clockwise to be upright
    upright = photo(tmp_path, exif=exif)
    assert (upright.height, upright.width) == SIZE[::-1]
    file = write(tmp_path / "a.npy", SLOPE)
    found = depth_of_photo(file, upright.source, (upright.height, upright.width))
    np.testing.assert_allclose(found, np.rot90(SLOPE, -1), rtol=1e-6)
    turned = write(tmp_path / "b.npy", np.rot90(SLOPE, -1))
    np.testing.assert_array_equal(depth_of_photo(turned, upright.source, SIZE[::-1]), found)


@pytest.mark.parametrize("distortion", [(0.0, 0.0, 0.0, 0.0), (0.08, -0.02, 0.003, -0.002)])
def test_a_view_sees_a_plane_where_it_is(distortion: tuple[float, float, float, float]) -> None:
    """Inverse depth of a plane is linear on the undistorted picture, whatever the lens."""
    lens = PhotoCamera(np.eye(4), (110.0, 112.0), (66.0, 47.0), distortion, *SIZE)
    rows, columns = (part + 0.5 for part in np.mgrid[: SIZE[0] * 2, : SIZE[1] * 2].astype(float))
    pixels = np.stack([columns / 2, rows / 2], -1).reshape(-1, 1, 2)  # a map of twice the photo's size
    x, y = cv2.undistortPoints(pixels, lens.K, np.array(distortion))[:, 0].T.reshape(2, *rows.shape)
    depth = 1 / (0.3 + 0.1 * x - 0.05 * y)
    K, size = np.array([[70.0, 0, 41], [0, 71, 30], [0, 0, 1]]), (60, 80)
    v, u = (part + 0.5 for part in np.mgrid[: size[0], : size[1]])
    wanted = 1 / (0.3 + 0.1 * (u - K[0, 2]) / K[0, 0] - 0.05 * (v - K[1, 2]) / K[1, 1])
    seen = depth_of_view(depth.astype(np.float32), lens, K, size)
    inside = np.s_[3:-3, 3:-3]
    np.testing.assert_allclose(seen[inside], wanted[inside], rtol=2e-4)


def test_no_depth_lies_between_the_sides_of_an_edge() -> None:
    depth = np.full((24, 32), 2.0, np.float32)
    depth[:, 16:] = 5.0
    depth[:, 28:] = 0
    camera = PhotoCamera.pinhole(np.eye(4), np.array([[100.0, 0, 64], [0, 100, 48], [0, 0, 1]]), *SIZE)
    seen = depth_of_view(depth, camera, camera.K, SIZE)
    assert set(np.unique(seen.round(4))) == {0, 2, 5}
    assert [int((seen[50] == each).sum()) for each in (2, 5, 0)] == [64, 48, 16]


def test_nerfstudio_lists_maps_beside_its_frames(tmp_path: Path) -> None:
    frames = [
        {"file_path": "images/a.jpg", "depth_file_path": "depth\\a.png", "transform_matrix": np.eye(4).tolist()},
        {"file_path": "images/b.jpg", "depth_file_path": 3, "transform_matrix": np.eye(4).tolist()},
        {"file_path": "images/c.jpg", "transform_matrix": np.eye(4).tolist()},
    ]
    (tmp_path / "transforms.json").write_text(json.dumps({"w": 128, "h": 96, "fl_x": 100, "frames": frames}))
    listed = {name: camera.depth_map for name, camera in read_transforms(tmp_path / "transforms.json").items()}
    assert listed == {"a.jpg": tmp_path / "depth" / "a.png", "b.jpg": None, "c.jpg": None}
