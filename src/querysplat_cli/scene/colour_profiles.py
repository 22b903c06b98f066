"""The colours of a picture file as sRGB, whichever colour space the file states.

Many phones take photos in Display P3, and cameras may take them in Adobe RGB. Viewers show scenes as sRGB, where the
numbers of both look pale.
"""

import io
import struct
from functools import cache, lru_cache

import numpy as np
from PIL import ExifTags, Image, ImageCms

UNSEEN = 2
"""Of 255. Profiles that change no colour by more are sRGB under another name, and pixels stay as they are."""
LATTICE = 17
"""Levels of each channel in the colours by which that is decided."""
KINDS = {"RGB": "RGB", "L": "GRAY", "CMYK": "CMYK"}
"""ICC's names of the kinds of pixels, by Pillow's."""
OPTION_FILE = "R03"
"""EXIF's interoperability index of Adobe RGB (DCF 2.0, JEITA CP-3461). Many cameras write no profile beside it."""
D65 = 0.3127, 0.329
ADOBE_PRIMARIES = (0.64, 0.33), (0.21, 0.71), (0.15, 0.06)
ADOBE_GAMMA = 563 / 256
D50 = np.array([0.9642, 1.0, 0.8249])
"""X, Y and Z of ICC's white, to which profiles adapt their primaries by Bradford's matrix (ICC.1, annex E)."""
BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])


def stated_profile(image: Image.Image) -> bytes | None:
    """The ICC profile inside a picture file, or that of Adobe RGB where EXIF names it; None where nothing is stated."""
    profile: bytes | None = image.info.get("icc_profile")
    return profile or (adobe_rgb() if _says_adobe(image) else None)


def _says_adobe(image: Image.Image) -> bool:
    try:
        index = image.getexif().get_ifd(ExifTags.IFD.Interop).get(ExifTags.Interop.InteropIndex, "")
    except (ValueError, TypeError, KeyError, SyntaxError, OSError):
        return False
    return str(index).strip("\0 ") == OPTION_FILE


def in_srgb(pixels: np.ndarray, profile: bytes | None) -> np.ndarray:
    """8-bit sRGB [height, width, 3] of grey [height, width], RGB [height, width, 3] or CMYK [height, width, 4].

    Colours beyond sRGB are clipped (relative colorimetric, with black point compensation). A profile that is damaged,
    or that describes pixels of another kind, is ignored, as viewers do.
    """
    image = Image.fromarray(pixels, _mode(pixels))
    transform = _to_srgb(profile, image.mode) if profile else None
    if transform is None:
        return pixels if image.mode == "RGB" else np.array(image.convert("RGB"))
    return np.array(ImageCms.applyTransform(image, transform))


def _mode(pixels: np.ndarray) -> str:
    """Pillow's name of grey, RGB or CMYK."""
    return "L" if pixels.ndim == 2 else "RGB" if pixels.shape[2] == 3 else "CMYK"


@lru_cache(maxsize=8)
def _to_srgb(profile: bytes, mode: str) -> ImageCms.ImageCmsTransform | None:
    """The transform from a profile to sRGB; None where it says nothing else, or cannot be used."""
    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        if source.profile.xcolor_space.strip() != KINDS[mode]:
            return None
        intent, flags = ImageCms.Intent.RELATIVE_COLORIMETRIC, ImageCms.Flags.BLACKPOINTCOMPENSATION
        transform = ImageCms.buildTransform(source, ImageCms.createProfile("sRGB"), mode, "RGB", intent, flags)
    except (ImageCms.PyCMSError, OSError, ValueError):
        return None
    colours = Image.fromarray(_lattice(len(mode)), mode)
    change = np.asarray(ImageCms.applyTransform(colours, transform), np.int64) - np.asarray(colours.convert("RGB"))
    return transform if np.abs(change).max() > UNSEEN else None


def _lattice(channels: int) -> np.ndarray:
    """Colours that are spread evenly over all that there are, [rows, columns] of grey or [rows, columns, channels]."""
    levels = np.linspace(0, 255, LATTICE).round().astype(np.uint8)
    colours = np.stack(np.meshgrid(*[levels] * channels, indexing="ij"), -1).reshape(LATTICE, -1, channels)
    return colours[..., 0] if channels == 1 else colours


@cache
def adobe_rgb() -> bytes:
    """An ICC profile of Adobe RGB (1998)."""
    return matrix_profile(ADOBE_PRIMARIES, D65, ADOBE_GAMMA)


def matrix_profile(primaries: tuple[tuple[float, float], ...], white: tuple[float, float], gamma: float) -> bytes:
    """An ICC profile, version 2.1, of an RGB display: three primaries and a white in CIE x and y, and an exponent."""
    shares = np.array([(x / y, 1.0, (1 - x - y) / y) for x, y in (*primaries, white)])
    columns = np.linalg.solve(shares[:3].T, shares[3])[:, None] * shares[:3]
    adapted = np.linalg.inv(BRADFORD) @ np.diag(BRADFORD @ D50 / (BRADFORD @ shares[3])) @ BRADFORD
    curve = struct.pack(">4sxxxxIHxx", b"curv", 1, round(gamma * 256))
    parts = dict(zip((b"rXYZ", b"gXYZ", b"bXYZ", b"wtpt"), map(_xyz, (*columns @ adapted.T, D50)), strict=True))
    parts |= dict.fromkeys((b"rTRC", b"gTRC", b"bTRC"), curve)
    start = 128 + 4 + 12 * len(parts)
    ends = start + np.cumsum([len(part) for part in parts.values()])
    table = b"".join(
        struct.pack(">4sII", name, end - len(part), len(part))
        for (name, part), end in zip(parts.items(), ends.tolist(), strict=True)
    )
    head = struct.pack(">IxxxxI4s4s4s12x4s28x", int(ends[-1]), 0x02100000, b"mntr", b"RGB ", b"XYZ ", b"acsp")
    light = struct.pack(">3i", *(round(value * 65536) for value in D50))
    return (head + light).ljust(128, b"\0") + struct.pack(">I", len(parts)) + table + b"".join(parts.values())


def _xyz(values: np.ndarray) -> bytes:
    return struct.pack(">4sxxxx3i", b"XYZ ", *(round(value * 65536) for value in values.tolist()))
