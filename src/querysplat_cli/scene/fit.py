"""Photos to the pictures that a network of fixed size looks at (spec, section 2)."""

from dataclasses import dataclass

from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn import functional as F

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


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
        """What is added to the principal point (x, y) before `scale`, as the release does it."""
        return (self.width - self.photo[1]) / 2, (self.height - self.photo[0]) / 2

    @property
    def scale(self) -> tuple[float, float]:
        """Picture pixels in a photo's pixel, along x and y."""
        return self.size[1] / self.width, self.size[0] / self.height

    def picture(self, photo: UInt8[Tensor, "3 rows columns"]) -> Float[Tensor, "3 height width"]:
        """The picture in [0, 1]: cut, and resized bilinearly with antialiasing where the size does not fit."""
        rows, columns = slice(self.top, self.top + self.height), slice(self.left, self.left + self.width)
        return resized(photo[:, rows, columns].float() / 255, self.size)


def centred_crop(photo: tuple[int, int], size: tuple[int, int]) -> Crop:
    """The largest rectangle in the middle of a photo that has the aspect of `size`; both are (height, width)."""
    ratio = min(photo[0] / size[0], photo[1] / size[1])
    height, width = int(size[0] * ratio), int(size[1] * ratio)
    return Crop(round((photo[0] - height) / 2), round((photo[1] - width) / 2), height, width, photo, size)


def resized(picture: Float[Tensor, "3 rows columns"], size: tuple[int, int]) -> Float[Tensor, "3 height width"]:
    """Bilinear, antialiased."""
    if picture.shape[-2:] == size:
        return picture
    return F.interpolate(picture[None], size, mode="bilinear", align_corners=False, antialias=True)[0]


def normalised(images: Float[Tensor, "*views 3 height width"]) -> Float[Tensor, "*views 3 height width"]:
    """By ImageNet's mean and deviation."""
    mean, std = (images.new_tensor(part)[:, None, None] for part in (IMAGENET_MEAN, IMAGENET_STD))
    return (images - mean) / std
