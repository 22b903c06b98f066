"""Photos and the images made of them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from querysplat_cli.scene.exif import Gps
from querysplat_cli.scene.masks import Overlay
from querysplat_cli.scene.resample import PinholeView


@dataclass(frozen=True)
class PhotoSource:
    """Where a photo comes from: a picture file, or the frame of a film with this presentation time stamp.

    `view` is the part of it that the photo shows, where its lens is too wide for a pinhole camera. `overlay` is what
    lies over the whole picture. `depth_map` is the file of a depth map that came with it.
    """

    path: Path
    pts: int | None = None
    view: PinholeView | None = None
    overlay: Overlay | None = None
    depth_map: Path | None = None


@dataclass(frozen=True)
class Photo:
    """One decoded photo: upright (EXIF orientation applied), 8-bit RGB [height, width, 3].

    Large photos are reduced when they are read, so `pixels` may be smaller than the file's picture. `focal` is
    the focal length in pixels of `pixels` where EXIF gives it, None otherwise. `pts` is the presentation time stamp
    of a film's frame; None for a photo. `mask` [height, width] is True where the photo takes part; None: everywhere.
    `panorama` is whether the file says that it shows 360°, `gps` where it was taken. `view` is the part of a wide photo
    that this one shows. `cut_from` is the (height, width), in pixels of this photo, of the picture that it is
    the middle of, where the program cut it. `orientation` is EXIF's, by which the stored pixels were turned. `overlay`
    is what lies over the whole picture; `mask` has it. `depth_map` is the file of a depth map that came with the photo.
    """

    name: str
    path: Path
    pixels: np.ndarray
    focal: float | None = None
    pts: int | None = None
    mask: np.ndarray | None = None
    panorama: bool = False
    gps: Gps | None = None
    view: PinholeView | None = None
    cut_from: tuple[int, int] | None = None
    orientation: int = 1
    overlay: Overlay | None = None
    depth_map: Path | None = None

    @property
    def source(self) -> PhotoSource:
        return PhotoSource(self.path, self.pts, self.view, self.overlay, self.depth_map)

    def under(self, overlay: Overlay | None) -> "Photo":
        """The same photo, in which what `overlay` covers takes no part."""
        if overlay is None:
            return self
        shown = overlay.shown(self.height, self.width)
        return replace(self, overlay=overlay, mask=shown if self.mask is None else self.mask & shown)

    @property
    def height(self) -> int:
        return int(self.pixels.shape[0])

    @property
    def width(self) -> int:
        return int(self.pixels.shape[1])


def forget_pixels(photos: list[Photo]) -> None:
    """Free the memory of the photos in the list. What needs them again finds them by their `source`."""
    photos[:] = [replace(photo, pixels=np.zeros((0, 0, 3), np.uint8), mask=None) for photo in photos]


@dataclass(frozen=True)
class Views:
    """Undistorted images on one canvas, each in its top-left corner.

    `images` are sRGB as stored, in [0, 1]. Large pictures are kept as uint8, from 0 to 255. `masks` are True where a
    picture covers the canvas and takes part, and False on the padding of smaller ones and where the user masked it.
    `sizes` are (height, width) of each picture in pixels.
    """

    images: Float[Tensor, "views 3 height width"] | UInt8[Tensor, "views 3 height width"]
    masks: Bool[Tensor, "views height width"]
    names: tuple[str, ...]
    sizes: tuple[tuple[int, int], ...]

    def __len__(self) -> int:
        return len(self.images)

    def picture(self, view: int) -> Float[Tensor, "3 height width"]:
        """One image in [0, 1]."""
        image = self.images[view]
        return image.float() / 255 if image.dtype == torch.uint8 else image

    def hide(self, view: int, pixels: Bool[Tensor, "height width"]) -> None:
        """These pixels of a view take no part from now on, in place."""
        self.masks[view] &= ~pixels

    def __getitem__(self, index: Sequence[int]) -> "Views":
        rows = torch.as_tensor(index, dtype=torch.long)
        return replace(
            self,
            images=self.images[rows],
            masks=self.masks[rows],
            names=tuple(self.names[i] for i in index),
            sizes=tuple(self.sizes[i] for i in index),
        )


@dataclass(frozen=True)
class LeftOut:
    """A photo that is not used, and the reason as a phrase for the user."""

    name: str
    why: str
