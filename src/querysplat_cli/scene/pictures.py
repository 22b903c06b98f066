"""Colours in [0, 1] as 8-bit pictures, and picture files."""

from collections.abc import Sequence
from pathlib import Path, PurePath

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

LOSSLESS_SUFFIXES = {".png", ".bmp", ".tif", ".tiff"}
WRITTEN_SUFFIXES = LOSSLESS_SUFFIXES | {".jpg", ".jpeg"}
"""Of photos whose pictures have the same format."""


def eight_bit(image: Float[Tensor, "3 height width"]) -> np.ndarray:
    """RGB [height, width, 3], rounded, of colours in [0, 1]."""
    return (image.permute(1, 2, 0) * 255).round().to(torch.uint8).numpy()


def linear_of_srgb(colours: np.ndarray) -> np.ndarray:
    """Linear values of sRGB ones, both in [0, 1]."""
    return np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)


def stored_names(names: Sequence[str]) -> dict[str, str]:
    """The file names of the photos' undistorted pictures, by the names of the photos.

    They are those of the photos, with .png added where we do not write the format. It is added again where that is the
    name of another photo.
    """
    photos, found = set(names), {}
    for name in names:
        found[name] = name
        if Path(name).suffix.lower() in WRITTEN_SUFFIXES:
            continue
        while found[name] in photos:
            found[name] += ".png"
    return found


def distinct_stems(names: Sequence[str]) -> list[str]:
    """Names of photos without their suffixes, or with them where two photos differ in that alone."""
    stems = [str(PurePath(name).with_suffix("")) for name in names]
    return stems if len(set(stems)) == len(stems) else list(names)


def write_picture(path: Path, pixels: np.ndarray, settings: Sequence[int] = ()) -> None:
    """Write RGB [height, width, 3], or grey [height, width] of 8 or 16 bits, in the format of `path`'s suffix.

    Makes the folder if it is missing; `settings` are OpenCV's. Raises OSError when the file cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(path), pixels[..., ::-1] if pixels.ndim == 3 else pixels, settings):
        raise OSError(f"cannot write {path}")
