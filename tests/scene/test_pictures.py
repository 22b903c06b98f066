"""Colours in [0, 1] to files and back."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from querysplat_cli.scene.pictures import distinct_stems, eight_bit, write_picture


def test_what_is_written_is_read(tmp_path: Path) -> None:
    """By another library: red stays red, halves round up, 16 bits stay 16."""
    colours = torch.tensor([[[0.0, 1.0]], [[0.4, 0.5]], [[0.2, 0.9999]]])
    expected = np.array([[[0, 102, 51], [255, 128, 255]]], np.uint8)
    write_picture(tmp_path / "new" / "a.png", eight_bit(colours))
    assert np.array_equal(np.asarray(Image.open(tmp_path / "new" / "a.png")), expected)
    depth = np.array([[0, 40_000]], np.uint16)
    write_picture(tmp_path / "depth.png", depth)
    assert np.array_equal(np.asarray(Image.open(tmp_path / "depth.png")), depth)


def test_a_picture_that_cannot_be_written_is_no_picture(tmp_path: Path) -> None:
    (tmp_path / "a.png").mkdir()
    with pytest.raises(OSError, match="cannot write"):
        write_picture(tmp_path / "a.png", np.zeros((2, 2, 3), np.uint8))


@pytest.mark.parametrize(
    ("names", "stems"),
    [(["a.jpg", "b/c.JPG"], ["a", "b/c"]), (["a.jpg", "a.png"], ["a.jpg", "a.png"])],
)
def test_photos_of_one_stem_have_pictures_of_their_own(names: list[str], stems: list[str]) -> None:
    assert distinct_stems(names) == stems
