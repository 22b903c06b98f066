"""Colours of files in other colour spaces than sRGB, against closed forms in float64."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image, ImageCms

from querysplat_cli.scene.colour_profiles import ADOBE_GAMMA, ADOBE_PRIMARIES, D65, adobe_rgb, in_srgb, matrix_profile
from querysplat_cli.scene.photos import load_photo
from querysplat_cli.scene.views import Photo

P3_PRIMARIES = (0.68, 0.32), (0.265, 0.69), (0.15, 0.06)
SRGB_PRIMARIES = (0.64, 0.33), (0.30, 0.60), (0.15, 0.06)
GAMMA = 2.2
P3 = matrix_profile(P3_PRIMARIES, D65, GAMMA)
SRGB = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
CORNERS = np.indices((2, 2, 2), np.uint8).reshape(3, 4, 2).transpose(1, 2, 0) * 255
COLOURS = np.concatenate(
    [np.random.default_rng(0).integers(0, 256, (96, 128, 3), np.uint8), np.tile(CORNERS, (1, 64, 1))]
)
CLOSE = 1.5
"""Of 255: rounding to 8 bits, and that of LittleCMS inside."""


def to_xyz(primaries: tuple[tuple[float, float], ...]) -> np.ndarray:
    columns = np.array([(x / y, 1, (1 - x - y) / y) for x, y in (*primaries, D65)]).T
    return columns[:, :3] * np.linalg.solve(columns[:, :3], columns[:, 3])


def expected(stored: np.ndarray, primaries: tuple[tuple[float, float], ...], gamma: float) -> np.ndarray:
    """sRGB, from 0 to 255, of stored RGB."""
    light = (stored / 255) ** gamma @ (np.linalg.inv(to_xyz(SRGB_PRIMARIES)) @ to_xyz(primaries)).T
    return 255 * srgb_code(light.clip(0, 1))


def srgb_code(light: np.ndarray) -> np.ndarray:
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)


@pytest.mark.parametrize(
    ("profile", "primaries", "gamma"), [(P3, P3_PRIMARIES, GAMMA), (adobe_rgb(), ADOBE_PRIMARIES, ADOBE_GAMMA)]
)
def test_colours_of_wider_spaces_become_srgb(
    profile: bytes, primaries: tuple[tuple[float, float], ...], gamma: float
) -> None:
    wanted = expected(COLOURS, primaries, gamma)
    assert np.abs(wanted - COLOURS).max() > 30
    assert np.abs(in_srgb(COLOURS, profile) - wanted).max() < CLOSE


def test_a_grey_profile_changes_the_curve() -> None:
    grey_profile = P3.replace(b"RGB XYZ ", b"GRAYXYZ ").replace(b"rTRC", b"kTRC")
    grey = np.arange(256, dtype=np.uint8).reshape(16, 16)
    found = in_srgb(grey, grey_profile)
    assert np.abs(found - 255 * srgb_code((grey / 255.0) ** GAMMA)[..., None]).max() < CLOSE
    np.testing.assert_array_equal(in_srgb(grey, None), grey[..., None].repeat(3, 2))


@pytest.mark.parametrize("profile", [None, SRGB, b"", P3[:200], P3.replace(b"RGB XYZ ", b"CMYKXYZ ")])
def test_pixels_stay_where_a_profile_is_srgb_or_cannot_be_used(profile: bytes | None) -> None:
    np.testing.assert_array_equal(in_srgb(COLOURS, profile), COLOURS)


def loaded(path: Path) -> np.ndarray:
    photo = load_photo(path, path.name, 1600)
    assert isinstance(photo, Photo)
    return photo.pixels.astype(np.float64)


@pytest.mark.parametrize("suffix", [".png", ".tif", ".webp", ".jpg"])
def test_a_photo_in_display_p3_is_read_in_its_colours(tmp_path: Path, suffix: str) -> None:
    smooth = cv2.resize(COLOURS[:6, :8], (128, 96), interpolation=cv2.INTER_CUBIC) // 2 + 64
    kind = {".webp": {"lossless": True}, ".jpg": {"quality": 100, "subsampling": 0}}.get(suffix, {})
    Image.fromarray(smooth).save(tmp_path / f"a{suffix}", icc_profile=P3, **kind)
    error = np.abs(loaded(tmp_path / f"a{suffix}") - expected(smooth, P3_PRIMARIES, GAMMA))
    assert error.mean() < 0.75
    assert suffix == ".jpg" or error.max() < CLOSE


def test_exif_marks_adobe_rgb(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.IFD.Interop] = {ExifTags.Interop.InteropIndex: "R03"}
    Image.fromarray(COLOURS).save(tmp_path / "_DSC1.webp", lossless=True, exif=exif)
    assert np.abs(loaded(tmp_path / "_DSC1.webp") - expected(COLOURS, ADOBE_PRIMARIES, ADOBE_GAMMA)).max() < CLOSE
