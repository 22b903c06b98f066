"""Masks: which pixels of a photo take part.

They are files in a folder `masks`, or the photo's own alpha channel. What lies over all photos takes no part, either
(`scene/overlays.py`).
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool
from PIL import Image, ImageOps

from querysplat_cli.scene.cameras import same_shape
from querysplat_cli.scene.resample import MOST

MASKS, IMAGES = "masks", "images"
WHOLLY = 0.99
"""A reduced pixel takes part when at least this share of it does, so that no masked colour is mixed in."""
ROUNDED = 0.01
"""Pixels by which the edges of a box may be off, because its numbers are rounded."""

QUARTER_TURNS = {6: 3, 8: 1}
"""Counter-clockwise quarter turns that an EXIF orientation asks for, where the picture is on its side."""


@dataclass(frozen=True)
class Overlay:
    """What an overlay covers, whatever size the photo is read at: boxes (left, top, right, bottom) in photo widths."""

    boxes: tuple[tuple[float, float, float, float], ...]

    def fault(self) -> str:
        """Why no photo has such an overlay, or ""."""
        inside = all(0 <= left < right <= MOST and 0 <= top < bottom <= MOST for left, top, right, bottom in self.boxes)
        return "" if inside else "a box of its overlay lies outside of it"

    @lru_cache(maxsize=8)  # noqa: B019 - photos of one size share the array
    def shown(self, height: int, width: int) -> np.ndarray:
        """True [height, width] where a photo of this size shows the scene."""
        shown = np.ones((height, width), bool)
        edges = np.reshape(self.boxes, (-1, 4)) * width
        starts, ends = np.floor(edges[:, :2] + ROUNDED), np.ceil(edges[:, 2:] - ROUNDED)
        for left, top, right, bottom in np.hstack([starts, ends]).astype(int):
            shown[top:bottom, left:right] = False
        return shown


@dataclass(frozen=True)
class MaskedShare:
    """How many photos show what was looked for and masked, and the share of the pixels of all photos that this is."""

    photos: int
    share: float

    @classmethod
    def of(cls, pixels: Mapping[int, int], sizes: Sequence[tuple[int, int]]) -> "MaskedShare | None":
        """That of so many `pixels` in each of some views, where all views have these (height, width); None for none."""
        whole = sum(height * width for height, width in sizes)
        return cls(len(pixels), sum(pixels.values()) / whole) if pixels else None


class BadMask(Exception):
    """A mask that cannot be used. Its text is a phrase for the user."""


def mask_file(photo: Path) -> Path | None:
    """The mask of a photo, if it has one.

    For `images_4/a.jpg` these are, in this order, `images_4/masks/`, `masks_4/` and `masks/` with `a.jpg.png` (COLMAP),
    `a.png` or `a.jpg` (nerfstudio).
    """
    folder = Path(os.path.abspath(photo)).parent  # a photo may be given from inside its folder
    level = folder.name.removeprefix(IMAGES) if folder.name.startswith(IMAGES) else ""
    for place in dict.fromkeys((folder / MASKS, folder.parent / f"{MASKS}{level}", folder.parent / MASKS)):
        if place.is_dir():
            for name in (f"{photo.name}.png", f"{photo.stem}.png", photo.name):
                if (place / name).is_file():
                    return place / name
    return None


def read_mask(path: Path, height: int, width: int, orientation: int = 1) -> np.ndarray:
    """True [height, width] where the photo takes part: where the mask is brighter than half of its brightest pixel.

    A mask of a photo on its side may be drawn on the upright pixels or, as COLMAP reads them, on the stored ones, which
    EXIF's `orientation` turns. Raises BadMask, with a phrase for the user, when the mask cannot be read or has another
    shape than the photo.
    """
    try:
        with Image.open(path) as image:
            grey = np.asarray(ImageOps.exif_transpose(image).convert("L"), np.int64)
    except Exception as error:  # damage can raise anything in Pillow's decoders
        raise BadMask(f"its mask {path.name} cannot be read") from error
    if not same_shape(grey.shape, (height, width)):
        grey = np.rot90(grey, QUARTER_TURNS.get(orientation, 0))
    if not same_shape(grey.shape, (height, width)):
        raise BadMask(f"its mask {path.name} is {grey.shape[1]} × {grey.shape[0]}, another shape than the photo's")
    return resized_mask(2 * grey > grey.max(), height, width)


def spread(operation: int, area: Bool[np.ndarray, "height width"], side: int) -> Bool[np.ndarray, "height width"]:
    """A morphological operation of OpenCV's with a square of `side` pixels."""
    return np.asarray(cv2.morphologyEx(area.astype(np.uint8), operation, np.ones((side, side), np.uint8)) > 0)


def resized_mask(mask: np.ndarray, height: int, width: int) -> np.ndarray:
    """A mask [rows, columns] at another size."""
    if mask.shape == (height, width):
        return mask
    shares = cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(shares >= WHOLLY)
