"""Photos resized for a network: cropped to a square or padded, sides multiples of its patch, ImageNet's statistics."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn import functional as F

from querysplat_cli.runtime.choices import Fit
from querysplat_cli.scene.masks import WHOLLY, resized_mask
from querysplat_cli.scene.views import Photo, Views

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


def network_views(photos: Sequence[Photo], size: int, patch: int, fit: Fit) -> Views:
    """The photos as inputs of a network: sides of at most `size` pixels, multiples of `patch`.

    A padded photo is centred on its canvas, which is white and masked around it, so that the optical axis stays in the
    middle.
    """
    side = size // patch * patch
    pixels = [torch.from_numpy(np.ascontiguousarray(photo.pixels)).permute(2, 0, 1) for photo in photos]
    if fit == "crop":
        images = torch.stack([centred_crop(_size(each), (side, side)).picture(each) for each in pixels])
        masks = torch.ones(len(photos), side, side, dtype=torch.bool)
        for mask, photo in zip(masks, photos, strict=True):
            if photo.mask is not None:
                mask &= centred_crop(photo.mask.shape, (side, side)).picture(_as_picture(photo.mask))[0] >= WHOLLY
    else:
        images, masks = _padded(pixels, side, patch)
        for mask, photo in zip(masks, photos, strict=True):
            if photo.mask is not None:
                mask[mask.clone()] = _within(mask, photo.mask)
    canvas = (images.shape[-2], images.shape[-1])
    return Views(images, masks, tuple(photo.name for photo in photos), (canvas,) * len(photos))


@dataclass(frozen=True)
class Crop:
    """A rectangle of a photo of `photo` (height, width) pixels, which becomes a picture of `size`."""

    top: int
    left: int
    height: int
    width: int
    photo: tuple[int, int]
    size: tuple[int, int]

    @property
    def shift(self) -> tuple[float, float]:
        """The shift of the principal point (x, y) before `scale` is applied, as in the release."""
        return (self.width - self.photo[1]) / 2, (self.height - self.photo[0]) / 2

    @property
    def scale(self) -> tuple[float, float]:
        """Pixels of the picture for each pixel of the photo, along x and y."""
        return self.size[1] / self.width, self.size[0] / self.height

    def picture(self, photo: UInt8[Tensor, "3 rows columns"]) -> Float[Tensor, "3 height width"]:
        """The picture in [0, 1]: cropped, then resized where the size differs."""
        rows, columns = slice(self.top, self.top + self.height), slice(self.left, self.left + self.width)
        return resized(photo[:, rows, columns].float() / 255, self.size)


def centred_crop(photo: tuple[int, int], size: tuple[int, int]) -> Crop:
    """The largest rectangle in the middle of a photo that has the aspect of `size`; both are (height, width)."""
    ratio = min(photo[0] / size[0], photo[1] / size[1])
    height, width = int(size[0] * ratio), int(size[1] * ratio)
    return Crop(round((photo[0] - height) / 2), round((photo[1] - width) / 2), height, width, photo, size)


def resized(picture: Float[Tensor, "3 rows columns"], size: tuple[int, int]) -> Float[Tensor, "3 height width"]:
    """Resized bilinearly, with antialiasing where it shrinks. Corners are mapped to corners."""
    if picture.shape[-2:] == size:
        return picture
    return F.interpolate(picture[None], size, mode="bilinear", align_corners=False, antialias=True)[0]


def normalised(images: Float[Tensor, "*views 3 height width"]) -> Float[Tensor, "*views 3 height width"]:
    """Less ImageNet's mean, divided by its standard deviation."""
    mean, std = (images.new_tensor(part)[:, None, None] for part in (IMAGENET_MEAN, IMAGENET_STD))
    return (images - mean) / std


def _padded(pixels: Sequence[Tensor], side: int, patch: int) -> tuple[Tensor, Tensor]:
    """Images and masks."""
    fitted = []
    for each in pixels:
        height, width = _size(each)
        scale = side / max(height, width)
        fitted.append(resized(each.float() / 255, (max(1, round(height * scale)), max(1, round(width * scale)))))
    rows, columns = (-(-max(_size(each)[axis] for each in fitted) // patch) * patch for axis in (0, 1))
    images, masks = torch.ones(len(pixels), 3, rows, columns), torch.zeros(len(pixels), rows, columns, dtype=torch.bool)
    for image, mask, each in zip(images, masks, fitted, strict=True):
        height, width = _size(each)
        top, left = (rows - height) // 2, (columns - width) // 2
        image[:, top : top + height, left : left + width] = each
        mask[top : top + height, left : left + width] = True
    return images, masks


def _as_picture(mask: np.ndarray) -> Tensor:
    """255 where the mask is True, in three channels."""
    return torch.from_numpy(mask.astype(np.uint8) * 255).expand(3, -1, -1)


def _within(mask: Tensor, shown: np.ndarray) -> Tensor:
    """A photo's mask at the size of the rectangle in which `mask` is True, flattened."""
    height, width = int(mask.any(1).sum()), int(mask.any(0).sum())
    return torch.from_numpy(resized_mask(shown, height, width)).flatten()


def _size(picture: Tensor) -> tuple[int, int]:
    return picture.shape[-2], picture.shape[-1]
