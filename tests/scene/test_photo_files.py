"""Finding a scene's photos again, and their large undistorted views."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.photo_files import (
    PhotoFile,
    check_photo_files,
    large_views,
    photo_files,
    read_photo_files,
    write_photo_files,
)
from querysplat_cli.scene.photos import load_photos
from querysplat_cli.scene.undistort import undistorted
from querysplat_cli.scene.views import PhotoSource

SHAPES = ((240, 320), (240, 180))
DISTORTED = (0.08, -0.02, 0.001, 0.0)


def camera(shape: tuple[int, int]) -> PhotoCamera:
    """The camera of a photo that was read at half of its size."""
    height, width = shape[0] // 2, shape[1] // 2
    w2c = np.eye(4)
    w2c[:3, 3] = 0.1, 0.2, 3.0
    return PhotoCamera(w2c, (150.0, 151.0), (width / 2, height / 2 - 2), DISTORTED, height, width)


@pytest.fixture
def files(tmp_path: Path) -> tuple[PhotoFile, ...]:
    names = ("a.png", "b.png")
    for seed, (name, (height, width)) in enumerate(zip(names, SHAPES, strict=True)):
        noise = np.random.default_rng(seed).integers(0, 255, (height // 8, width // 8, 3), dtype=np.uint8)
        cv2.imwrite(str(tmp_path / name), cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC))
    sources = {name: PhotoSource(tmp_path / name) for name in names}
    return photo_files(names, [camera(shape) for shape in SHAPES], sources)


def test_large_views_are_those_of_the_photos_themselves(files: tuple[PhotoFile, ...]) -> None:
    """Views of 96 pixels become views of 240, as if the photos had been undistorted at that size at once."""
    photos, _ = load_photos([file.path for file in files])
    lenses = [camera(shape) for shape in SHAPES]
    small, cameras = undistorted(photos, lenses, max_size=96)
    expected, theirs = undistorted(photos, lenses, max_size=240)
    views, found = large_views(files, small, cameras, 240)
    assert views.images.dtype == torch.uint8
    assert views.sizes == expected.sizes == ((180, 240), (240, 180))
    assert views.masks.equal(expected.masks)
    assert float((views.picture(0) - expected.images[0]).abs().max()) < 0.5 / 255 + 1e-6
    torch.testing.assert_close(found.K, theirs.K, rtol=1e-5, atol=1e-3)
    assert (found.height, found.width) == (theirs.height, theirs.width)
    assert found.w2c.equal(cameras.w2c)


def test_corrected_cameras_stay_corrected(files: tuple[PhotoFile, ...]) -> None:
    photos, _ = load_photos([file.path for file in files])
    small, cameras = undistorted(photos, [camera(shape) for shape in SHAPES], max_size=96)
    longer = cameras.K.clone()
    longer[:, 0, 0] *= 1.1
    _, before = large_views(files, small, cameras, 240)
    _, after = large_views(files, small, replace(cameras, K=longer), 240)
    torch.testing.assert_close(after.K[:, 0, 0], 1.1 * before.K[:, 0, 0])


def test_the_size_in_the_file_is_found(files: tuple[PhotoFile, ...]) -> None:
    assert [file.full_size() for file in files] == list(SHAPES)


def test_round_trip(files: tuple[PhotoFile, ...], tmp_path: Path) -> None:
    write_photo_files(tmp_path / "photos.json", files)
    assert read_photo_files(tmp_path / "photos.json") == {file.name: file for file in files}
    assert read_photo_files(tmp_path / "none.json") == {}


def test_views_that_were_never_resampled_have_no_files() -> None:
    assert photo_files(("a.png",), None, {}) == ()


def test_photos_that_are_gone_are_named_in_one_line(files: tuple[PhotoFile, ...]) -> None:
    check_photo_files(files)
    files[1].path.unlink()
    with pytest.raises(QuerySplatError, match=r"^1 of the 2 photos of this scene are gone, such as .*b\.png$"):
        check_photo_files(files)


def test_a_photo_of_another_shape_is_refused(files: tuple[PhotoFile, ...]) -> None:
    cv2.imwrite(str(files[0].path), np.zeros((200, 200, 3), np.uint8))
    with pytest.raises(QuerySplatError, match="another shape"):
        files[0].load(100)


def test_another_photo_of_the_same_shape_is_refused_and_a_brighter_one_is_not(files: tuple[PhotoFile, ...]) -> None:
    photos, _ = load_photos([file.path for file in files])
    small, cameras = undistorted(photos, [camera(shape) for shape in SHAPES], max_size=96)
    picture = cv2.imread(str(files[0].path))
    cv2.imwrite(str(files[0].path), (picture * 0.6 + 80).astype(np.uint8))
    large_views(files, small, cameras, 240)
    cv2.imwrite(str(files[0].path), np.ascontiguousarray(picture[:, ::-1]))
    with pytest.raises(QuerySplatError, match=r"a\.png shows something else than when the scene was made"):
        large_views(files, small, cameras, 240)


def test_what_was_masked_stays_hidden_where_the_mask_is_gone(files: tuple[PhotoFile, ...]) -> None:
    """Otherwise, what was cut out would come into the scene."""
    mask = files[0].path.parent / "masks" / "a.png"
    mask.parent.mkdir()
    shown = cv2.circle(np.zeros(SHAPES[0], np.uint8), (160, 120), 80, 255, -1)
    cv2.imwrite(str(mask), shown)
    photos, _ = load_photos([file.path for file in files])
    small, cameras = undistorted(photos, [camera(shape) for shape in SHAPES], max_size=96)
    masked, _ = large_views(files, small, cameras, 240)
    mask.unlink()
    unmasked, _ = large_views(files, small, cameras, 240)
    border = (masked.masks[0] != unmasked.masks[0]).float().mean()
    assert not (masked.masks & ~unmasked.masks).any()
    assert border < 0.1 * (~masked.masks[0]).float().mean()
