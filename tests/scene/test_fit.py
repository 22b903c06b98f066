"""Photos to network pictures."""

from pathlib import Path

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st

from querysplat_cli.scene.fit import centred_crop, network_views, resized
from querysplat_cli.scene.views import Photo

SIDES = st.integers(64, 900)


@given(SIDES, SIDES, st.integers(1, 40).map(lambda n: 16 * n), st.integers(1, 40).map(lambda n: 16 * n))
def test_a_crop_is_the_largest_of_its_aspect_in_the_middle(height: int, width: int, rows: int, columns: int) -> None:
    crop = centred_crop((height, width), (rows, columns))
    assert 0 <= crop.top <= height - crop.height
    assert 0 <= crop.left <= width - crop.width
    assert abs(2 * crop.top - (height - crop.height)) <= 1
    assert abs(2 * crop.left - (width - crop.width)) <= 1
    assert crop.height > height - 1 - 1e-6 or crop.width > width - 1 - 1e-6
    ratio = min(height / rows, width / columns)
    assert abs(crop.height - rows * ratio) <= 1
    assert abs(crop.width - columns * ratio) <= 1


def photo(height: int, width: int) -> Photo:
    rows, columns = np.mgrid[:height, :width]
    pixels = np.stack([rows * 255 // height, columns * 255 // width, np.full_like(rows, 90)], 2).astype(np.uint8)
    return Photo(f"{height}x{width}", Path("photo.png"), pixels)


def test_whole_photos_stand_in_the_middle_of_a_canvas_that_holds_all() -> None:
    views = network_views([photo(270, 480), photo(400, 300)], 512, 16, "pad")
    assert views.images.shape == (2, 3, 512, 512)
    assert views.masks[0].sum() == 288 * 512
    assert views.masks[1].sum() == 512 * 384
    assert torch.equal(views.masks, views.masks.flip(-1))
    assert torch.equal(views.masks, views.masks.flip(-2))
    assert (views.images[~views.masks[:, None].expand_as(views.images)] == 1).all()
    wide = network_views([photo(270, 480)], 512, 16, "pad")
    assert wide.images.shape == (1, 3, 288, 512)
    assert wide.masks.all()


def test_squares_lose_the_ends_of_the_longer_side() -> None:
    views = network_views([photo(270, 480), photo(400, 300)], 500, 16, "crop")
    assert views.images.shape == (2, 3, 496, 496)
    assert views.masks.all()
    left = float(views.images[0, 1, :, 0].mean())
    assert abs(left - (480 - 270) / 2 / 480) < 0.01


def test_resizing_keeps_corners_and_means() -> None:
    ramp = torch.linspace(0, 1, 512)[None, None].repeat(3, 64, 1)
    small = resized(ramp, (32, 256))
    assert small.shape == (3, 32, 256)
    torch.testing.assert_close(small[:, 0, 1:-1], ramp.reshape(3, 64, 256, 2).mean(-1)[:, 0, 1:-1], atol=1e-5, rtol=0)
    assert resized(ramp, (64, 512)) is ramp
