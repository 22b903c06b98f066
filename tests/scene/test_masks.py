"""Masks beside the photos and alpha channels: which pixels take part, through all of the reading of photos."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import ExifTags, Image

from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.fit import network_views
from querysplat_cli.scene.masks import MaskedShare, mask_file
from querysplat_cli.scene.photo_files import PhotoFile, large_views
from querysplat_cli.scene.photos import find_photos, load_photos
from querysplat_cli.scene.undistort import undistorted
from querysplat_cli.scene.views import Photo

HEIGHT, WIDTH = 96, 160
LENS = PhotoCamera(np.eye(4), (150.0, 150.0), (80.0, 48.0), (0.1, 0.0, 0.0, 0.0), HEIGHT, WIDTH)


def left_half(height: int = HEIGHT, width: int = WIDTH) -> np.ndarray:
    mask = np.zeros((height, width), np.uint8)
    mask[:, : width // 2] = 255
    return mask


def save(path: Path, pixels: np.ndarray, **options: object) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, **options)
    return path


def grey(folder: Path, name: str = "a.jpg") -> Path:
    return save(folder / name, np.full((HEIGHT, WIDTH, 3), 120, np.uint8))


def load(path: Path, max_side: int = 1600) -> Photo:
    photos, left_out = load_photos([path], max_side)
    assert not left_out
    return photos[0]


@pytest.mark.parametrize(
    ("photo", "mask"),
    [
        ("images/a.jpg", "masks/a.jpg.png"),
        ("images/a.jpg", "masks/a.png"),
        ("images_4/a.jpg", "masks_4/a.png"),
        ("images_4/a.jpg", "masks/a.jpg"),
        ("a.jpg", "masks/a.jpg.png"),
    ],
)
def test_where_masks_are(tmp_path: Path, photo: str, mask: str) -> None:
    path = grey((tmp_path / photo).parent)
    assert mask_file(path) is None
    assert load(path).mask is None
    save(tmp_path / mask, left_half())
    assert mask_file(path) == tmp_path / mask
    found = load(path).mask
    assert found is not None
    assert found.shape == (HEIGHT, WIDTH)
    assert 0.45 < found.mean() < 0.52
    assert found[:, : WIDTH // 2 - 8].all()
    assert not found[:, WIDTH // 2 + 8 :].any()


@pytest.mark.parametrize(("place", "given"), [("images", "."), ("images", "a.jpg"), ("images/sub", "..")])
def test_masks_are_found_from_inside_the_folder(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, place: str, given: str
) -> None:
    grey(tmp_path / "images")
    save(tmp_path / "masks" / "a.png", left_half())
    (tmp_path / place).mkdir(exist_ok=True)
    monkeypatch.chdir(tmp_path / place)
    assert load(*find_photos([Path(given)])).mask is not None


def test_a_photo_that_is_a_link_keeps_its_mask(tmp_path: Path) -> None:
    stored = grey(tmp_path / "store")
    link = tmp_path / "set" / "images" / "a.jpg"
    link.parent.mkdir(parents=True)
    link.symlink_to(stored)
    save(tmp_path / "set" / "masks" / "a.png", left_half())
    photo = load(link)
    assert photo.mask is not None
    assert PhotoFile.of("a.jpg", photo.source, LENS).load(WIDTH).mask is not None


def test_masks_are_no_photos(tmp_path: Path) -> None:
    path = grey(tmp_path)
    save(tmp_path / "masks" / "a.png", left_half())
    assert find_photos([tmp_path]) == [path]


def test_masks_of_ones_and_zeros_and_of_another_size(tmp_path: Path) -> None:
    path = grey(tmp_path)
    save(tmp_path / "masks" / "a.png", left_half(48, 80) // 255)
    for side in (1600, 128):
        mask = load(path, side).mask
        assert mask is not None
        assert mask.shape == load(path, side).pixels.shape[:2]
        assert abs(mask.mean() - 0.5) < 0.02


def test_masks_turn_with_their_photos(tmp_path: Path) -> None:
    """A mask of the upright picture, as other tools make it, fits a photo that the phone stored lying."""
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6
    save(tmp_path / "a.jpg", np.full((HEIGHT, WIDTH, 3), 120, np.uint8), exif=exif)
    save(tmp_path / "masks" / "a.png", left_half(WIDTH, HEIGHT))
    mask = load(tmp_path / "a.jpg").mask
    assert mask is not None
    assert mask.shape == (WIDTH, HEIGHT)


def test_alpha_is_a_mask(tmp_path: Path) -> None:
    pixels = np.dstack([np.full((HEIGHT, WIDTH, 3), 120, np.uint8), left_half()])
    photo = load(save(tmp_path / "cut.png", pixels))
    assert photo.mask is not None
    np.testing.assert_array_equal(photo.mask, left_half() > 0)
    pixels[..., 3] = 255
    assert load(save(tmp_path / "whole.png", pixels)).mask is None


@pytest.mark.parametrize(
    ("mask", "why"),
    [
        (np.zeros((HEIGHT, WIDTH), np.uint8), "hides all"),
        (left_half(HEIGHT, HEIGHT), "another shape"),
        (None, "cannot be read"),
    ],
    ids=["black", "square", "damaged"],
)
def test_masks_that_cannot_be_used(tmp_path: Path, mask: np.ndarray | None, why: str) -> None:
    grey(tmp_path, "b.jpg")
    path = grey(tmp_path)
    if mask is None:
        (tmp_path / "masks").mkdir()
        (tmp_path / "masks" / "a.png").write_bytes(b"no picture")
    else:
        save(tmp_path / "masks" / "a.png", mask)
    _, left_out = load_photos([path, tmp_path / "b.jpg"])
    assert [each.name for each in left_out] == ["a.jpg"]
    assert why in left_out[0].why


def test_views_are_black_where_the_photo_is_masked(tmp_path: Path) -> None:
    photo = Photo("a.jpg", tmp_path, np.full((HEIGHT, WIDTH, 3), 120, np.uint8), mask=left_half() > 0)
    views, _ = undistorted([photo, replace(photo, mask=None)], [LENS, LENS], max_size=80)
    height, width = views.sizes[0]
    shown = views.masks[0, :height, :width]
    assert abs(float(shown.float().mean()) - 0.5) < 0.03
    assert (views.images[0, :, :height, :width].amax(0) > 0).equal(shown)
    assert views.masks[1, :height, :width].all()


@pytest.mark.parametrize(("orientation", "shown"), [(6, np.s_[: HEIGHT // 2, :]), (8, np.s_[HEIGHT // 2 :, :])])
def test_masks_of_the_stored_pixels_turn_with_their_photo(tmp_path: Path, orientation: int, shown: tuple) -> None:
    """A square would fit both ways; the photo is upright 120 × 96, and its mask is 96 × 120, as COLMAP reads photos."""
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    path = save(tmp_path / "a.jpg", np.full((120, HEIGHT, 3), 120, np.uint8), exif=exif)
    save(tmp_path / "masks" / "a.png", left_half(120, HEIGHT))
    mask = load(path).mask
    assert mask is not None
    expected = np.zeros((HEIGHT, 120), bool)
    expected[shown] = True
    assert np.array_equal(mask, expected)
    save(tmp_path / "masks" / "a.png", left_half(HEIGHT, 120))
    upright = load(path).mask
    assert upright is not None
    assert upright[:, :56].all()
    assert not upright[:, 64:].any()


def test_large_views_are_masked_too(tmp_path: Path) -> None:
    path = grey(tmp_path, "a.png")
    save(tmp_path / "masks" / "a.png", left_half())
    photo = load(path)
    small, cameras = undistorted([photo], [LENS], max_size=80)
    large, _ = large_views([PhotoFile.of("a.png", photo.source, LENS)], small, cameras, WIDTH)
    assert abs(float(large.masks[0, :HEIGHT, :WIDTH].float().mean()) - 0.5) < 0.03


@pytest.mark.parametrize("fit", ["crop", "pad"])
def test_views_of_networks_have_the_mask(tmp_path: Path, fit: str) -> None:
    pixels = np.full((HEIGHT, WIDTH, 3), 120, np.uint8)
    photo = Photo("a.jpg", tmp_path, pixels, mask=left_half() > 0)
    views = network_views([photo, replace(photo, mask=None)], 84, 14, fit)
    masked, whole = views.masks
    middle = masked.shape[1] // 2
    assert not masked[:, middle + 2 :].any()
    assert masked[:, : middle - 2].equal(whole[:, : middle - 2])
    assert torch.isfinite(views.images).all()


def test_the_share_counts_the_pixels_of_all_photos() -> None:
    found = MaskedShare.of({0: 30, 2: 20}, [(10, 10), (5, 20), (10, 20)])
    assert found == MaskedShare(photos=2, share=50 / 400)
    assert MaskedShare.of({}, [(10, 10)]) is None
