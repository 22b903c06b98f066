"""Working pictures no larger than the detail in the photos needs."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from querysplat_cli.prune.policy import PRUNE_POLICY
from querysplat_cli.prune.resolution import blurred
from querysplat_cli.scene.views import Photo

USUAL = 448


def photo(blur: float, *, height: int = 672, width: int = 896) -> Photo:
    """White noise of low contrast after a Gaussian blur of `blur` pixels, at twice the usual size."""
    pixels = np.random.default_rng(0).uniform(64, 192, (height, width, 3))
    if blur:
        pixels = cv2.GaussianBlur(pixels, (0, 0), blur)
    return Photo("a.png", Path("a.png"), pixels.round().astype(np.uint8))


def test_sharp_photos_keep_their_size() -> None:
    assert blurred([photo(0.0), photo(0.0)], USUAL) is None


@pytest.mark.parametrize("blur", [6.0, 12.0])
def test_blurred_photos_need_fewer_pixels(blur: float) -> None:
    found = blurred([photo(blur)], USUAL)
    assert found is not None
    assert found.usual == USUAL
    assert found.size <= 0.6 * USUAL
    assert found.psnr >= PRUNE_POLICY.same_psnr


def test_one_sharp_photo_keeps_the_size_for_all() -> None:
    assert blurred([photo(12.0), photo(0.0), photo(12.0)], USUAL) is None


def test_pictures_do_not_become_smaller_than_features_need() -> None:
    assert blurred([photo(12.0)], 170) is None
