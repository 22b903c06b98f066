"""One picture file of any kind, decoded: upright, 8-bit RGB, not too large."""

import warnings
from dataclasses import dataclass
from functools import cache
from importlib.resources.abc import Traversable
from pathlib import Path

import cv2
import numpy as np
from PIL import ExifTags, Image, ImageOps, TiffImagePlugin, UnidentifiedImageError

from querysplat_cli.runtime.optional_parts import install_command
from querysplat_cli.scene.colour_profiles import in_srgb, stated_profile
from querysplat_cli.scene.exif import Gps, focal_length, gps_place, says_panorama

HEIF_SUFFIXES = {".heic", ".heif"}
HEIF_MARKS = {b"ftypheic", b"ftypheix", b"ftyphevc", b"ftypmif1"}
"""What follows the first four bytes of a HEIC photo, which may have any suffix: phones and messengers write `.jpg`."""
RAW_SUFFIXES = {
    ".3fr", ".arw", ".cr2", ".cr3", ".crw", ".dng", ".erf", ".iiq", ".kdc", ".mrw", ".nef", ".nrw", ".orf", ".pef",
    ".raf", ".raw", ".rw2", ".rwl", ".srw", ".x3f",
}  # fmt: skip
ARCHIVE_SUFFIXES = {".zip", ".7z", ".rar", ".tar", ".tgz", ".gz", ".livp"}
OTHER_FILM_SUFFIXES = {".mts", ".m2ts", ".mpg", ".mpeg", ".wmv", ".flv"}
"""Mostly of camcorders, whose frames are two half pictures of different instants."""
WHY_NO_PHOTO = {
    **dict.fromkeys(RAW_SUFFIXES, "raw photos are not read; export it as JPEG"),
    **dict.fromkeys(ARCHIVE_SUFFIXES, "an archive; unpack it"),
    **dict.fromkeys(OTHER_FILM_SUFFIXES, "films of this kind are not read; save it as MP4"),
    ".thm": "the thumbnail that a camera keeps beside a film",
    ".lrv": "the small copy that a camera keeps beside a film",
}
ANIMATED = {"GIF", "WEBP", "PNG"}
"""Formats of which several pictures are an animation. JPEGs of phones hold previews and depth besides."""
HALF_OPAQUE = 128
"""Pixels of a smaller alpha, of 255, take no part."""
ON_THEIR_SIDE = {5, 6, 7, 8}
"""EXIF orientations of pictures that are stored with rows for columns."""
JPEG_PARTS = 8, 4, 2
"""Of the size of a JPEG, as Pillow can decode it."""
SUBFILE_TYPE = 254
"""A tag of TIFF. Its first bit marks a reduced copy of another picture of the file; raw photos begin with one."""
MOST_PIXELS = 500_000_000
"""Of a photo. Phones take 200 million."""

# Pillow's own limit is smaller, and its warnings, of large pictures and of damaged EXIF, tell the user nothing to do.
Image.MAX_IMAGE_PIXELS = MOST_PIXELS
warnings.filterwarnings("ignore", module=r"PIL\.")


@dataclass(frozen=True)
class Decoded:
    """A picture file: upright, reduced RGB, the focal length in its pixels, where it is opaque, and what EXIF says.

    `full` is the (height, width) of the upright picture before it was reduced. `orientation` is EXIF's.
    """

    pixels: np.ndarray
    full: tuple[int, int]
    focal: float | None = None
    opaque: np.ndarray | None = None
    panorama: bool = False
    gps: Gps | None = None
    orientation: int = 1


def decode(path: Path, max_side: int) -> Decoded:
    """A picture file whose longer side is at most `max_side` afterwards.

    Raises UnidentifiedImageError where it is no picture, DecompressionBombError where it has more than `MOST_PIXELS`,
    and whatever Pillow's decoders raise where it is damaged.
    """
    try:
        image = _opened(path)
    except UnidentifiedImageError:
        pixels = _decode_deep_tiff(path)
        return Decoded(reduced(pixels, max_side), pixels.shape[:2])
    with image:
        width, height = image.size
        if width * height > MOST_PIXELS:
            raise Image.DecompressionBombError
        if isinstance(image, TiffImagePlugin.TiffImageFile) and image.tag_v2.get(SUBFILE_TYPE, 0) & 1:
            raise ValueError("its first picture is a thumbnail, as in raw photos; export it as JPEG")
        if image.format in ANIMATED and getattr(image, "is_animated", False):
            raise ValueError("an animation; save it as an MP4 film")
        focal, panorama, gps = focal_length(image), says_panorama(image), gps_place(image)
        orientation = _orientation(image)
        # JPEG is read faster at a fraction of its size, but what is no whole multiple would be stretched by a pixel.
        parts = [n for n in JPEG_PARTS if width % n == height % n == 0 and max(width, height) >= n * max_side]
        if parts:
            image.draft("RGB", (width // parts[0], height // parts[0]))
        upright = ImageOps.exif_transpose(image)
        pixels = in_srgb(reduced(_stored(upright), max_side), stated_profile(image))
        opaque = np.asarray(upright.convert("RGBA").getchannel("A")) >= HALF_OPAQUE if _has_alpha(upright) else None
    full = _upright(width, height, orientation)
    focal = focal and focal * max(pixels.shape) / max(width, height)
    return Decoded(pixels, full, focal, opaque, panorama, gps, orientation)


def _stored(image: Image.Image) -> np.ndarray:
    """8-bit pixels in the colour space of the file: grey [height, width], RGB [height, width, 3], or CMYK."""
    if image.mode.startswith("I"):
        return (np.asarray(image, dtype=np.int64) >> 8).clip(0, 255).astype(np.uint8)
    if image.mode == "F":
        raise ValueError("floating-point pixels have no agreed white")
    if _has_alpha(image):
        colour = image.convert("RGBA")
        image = Image.alpha_composite(Image.new("RGBA", colour.size, "white"), colour)
    return np.array(image if image.mode in ("L", "CMYK") else image.convert("RGB"))


def _has_alpha(image: Image.Image) -> bool:
    return image.mode in ("RGBA", "LA", "La", "RGBa", "PA") or "transparency" in image.info


def _decode_deep_tiff(path: Path) -> np.ndarray:
    """TIFF kinds that Pillow cannot read, such as three channels of 16 bits."""
    pixels = cv2.imread(str(path), cv2.IMREAD_COLOR) if path.suffix.lower() in (".tif", ".tiff") else None
    if pixels is None:
        raise UnidentifiedImageError(path)
    return np.ascontiguousarray(pixels[..., ::-1])


def reduced(pixels: np.ndarray, max_side: int) -> np.ndarray:
    """Pixels [height, width] or [height, width, channels] whose longer side is at most `max_side` (area filter)."""
    height, width = pixels.shape[:2]
    scale = max_side / max(height, width)
    if scale >= 1:
        return pixels
    return cv2.resize(pixels, (round(width * scale), round(height * scale)), interpolation=cv2.INTER_AREA)


def no_photo(path: Path) -> str:
    """Why a file is no photo by its suffix, as a phrase for the user; "" where it may be one.

    Raw photos begin with a preview, which may be smaller than the photo, and would be another photo beside its JPEG.
    """
    return WHY_NO_PHOTO.get(path.suffix.lower(), "")


def why_not_a_picture(path: Path) -> str:
    """Why a file is no picture that can be read, as a phrase for the user."""
    with path.open("rb") as file:
        is_heif = file.read(12)[4:] in HEIF_MARKS or path.suffix.lower() in HEIF_SUFFIXES
    if is_heif and not _reads_heif():
        return f"HEIC needs one more package: {install_command('heic')}"
    return "not a picture that can be read"


def longer_side(path: Path) -> int:
    """The longer side of the picture in a file, in pixels; 0 where only its pixels show that."""
    try:
        with _opened(path) as image:
            return max(image.size)
    except UnidentifiedImageError:
        return 0


def upright_size(file: Traversable) -> tuple[int, int] | None:
    """(height, width) of the upright picture in a file; None where it cannot be read, or only its pixels show that."""
    _reads_heif()
    try:
        with file.open("rb") as stream, Image.open(stream) as image:
            return _upright(*image.size, _orientation(image))
    except Exception:  # damage can raise anything in Pillow's decoders
        return None


def orientation_of(path: Path) -> int:
    """EXIF's orientation of the picture in a file; 1, which is upright, where it states none."""
    try:
        with _opened(path) as image:
            return int(_orientation(image))
    except UnidentifiedImageError:
        return 1


def _orientation(image: Image.Image) -> int:
    """EXIF's, as it stands there; 1, which is upright, where it states none."""
    orientation: int = image.getexif().get(ExifTags.Base.Orientation, 1)
    return orientation


def _upright(width: int, height: int, orientation: int) -> tuple[int, int]:
    """(height, width) of the upright picture, of one that is stored with this width and height."""
    return (width, height) if orientation in ON_THEIR_SIDE else (height, width)


def _opened(path: Path) -> Image.Image:
    _reads_heif()  # a HEIC photo may have any suffix
    return Image.open(path)


@cache
def _reads_heif() -> bool:
    """Whether Pillow reads HEIC from now on: whether the package for it is installed."""
    try:
        from pillow_heif import register_heif_opener
    except ImportError:
        return False
    register_heif_opener()
    return True
