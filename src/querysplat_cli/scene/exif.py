"""What EXIF says about a photo."""

import re
from dataclasses import dataclass
from typing import Any

import numpy as np
from PIL import ExifTags, Image

from querysplat_cli.scene.cameras import same_shape

FULL_FRAME_DIAGONAL = 43.2666
"""Millimetres: FocalLengthIn35mmFilm is the focal length that has the same diagonal field of view on 36 × 24."""
SENSOR_SHAPES = (1.3, 1.55)
"""Longer over shorter sides between which sensors are. Squares and 16:9 are cut from sensors of 4:3."""
SENSIBLE_FOCAL = (0.3, 20.0)
"""Range of plausible focal lengths in units of the longer side. Others in EXIF are ignored."""
MILLIMETRES = {1: 25.4, 2: 25.4, 3: 10.0, 4: 1.0, 5: 1e-3}
"""Length of EXIF's FocalPlaneResolutionUnit; 1 means "none", which cameras write for inches."""


@dataclass(frozen=True)
class Gps:
    """Where a photo was taken: degrees north and east, and metres above sea level, if that is stated."""

    latitude: float
    longitude: float
    height: float | None = None


def gps_place(image: Image.Image) -> Gps | None:
    """EXIF's GPS position, if there is a whole and sensible one."""
    try:
        entries = image.getexif().get_ifd(ExifTags.IFD.GPSInfo)
        latitude = _degrees(entries[ExifTags.GPS.GPSLatitude], entries.get(ExifTags.GPS.GPSLatitudeRef, "N"))
        longitude = _degrees(entries[ExifTags.GPS.GPSLongitude], entries.get(ExifTags.GPS.GPSLongitudeRef, "E"))
        height = entries.get(ExifTags.GPS.GPSAltitude)
        below = entries.get(ExifTags.GPS.GPSAltitudeRef) in (1, b"\x01")
        metres = None if height is None else float(height) * (-1 if below else 1)
    except (ValueError, TypeError, ZeroDivisionError, KeyError, SyntaxError, OSError):
        return None
    sensible = abs(latitude) <= 90 and abs(longitude) <= 180 and np.isfinite([latitude, longitude, metres or 0.0]).all()
    # Cameras without reception write zeros.
    return Gps(latitude, longitude, metres) if sensible and (latitude or longitude) else None


def _degrees(parts: Any, reference: str) -> float:
    degrees, minutes, seconds = (float(part) for part in parts)
    return (degrees + minutes / 60 + seconds / 3600) * (-1 if reference in ("S", "W") else 1)


def focal_length(image: Image.Image) -> float | None:
    """EXIF's focal length in pixels of the picture as stored, if it is plausible."""
    width, height = image.size
    try:
        exif = image.getexif().get_ifd(ExifTags.IFD.Exif)
        if _was_cut(exif, width, height):
            return None
        focal = _focal_from_film(exif, width, height) or _focal_from_sensor(exif, width, height)
    except (ValueError, TypeError, ZeroDivisionError, KeyError, SyntaxError, OSError):
        return None
    low, high = SENSIBLE_FOCAL
    return focal if focal and low < focal / max(width, height) < high else None


def says_panorama(image: Image.Image) -> bool:
    """Whether XMP says that the picture shows 360° (GPano:ProjectionType, Google's photo sphere metadata).

    The panoramas of phones show a part of it: their cropped area is smaller than the full panorama.
    """
    packet = image.info.get("xmp", b"")
    text = packet if isinstance(packet, bytes) else str(packet).encode(errors="replace")
    sides = ("Width", "Height")
    cropped = [_stated(text, f"CroppedAreaImage{side}Pixels", rb"\d+") for side in sides]
    full = [_stated(text, f"FullPano{side}Pixels", rb"\d+") for side in sides]
    whole = all(part == all_of_it for part, all_of_it in zip(cropped, full, strict=True) if part and all_of_it)
    return whole and _stated(text, "ProjectionType", b"equirectangular") is not None


def _stated(xmp: bytes, name: str, pattern: bytes) -> bytes | None:
    """The value of a GPano entry that begins with the pattern."""
    found = re.search(rb"GPano:%s(?:=[\"']|>)\s*(%s)" % (name.encode(), pattern), xmp)
    return found[1] if found else None


def _focal_from_film(exif: dict[int, Any], width: int, height: int) -> float | None:
    film = float(exif.get(ExifTags.Base.FocalLengthIn35mmFilm, 0))
    longer, shorter = float(max(width, height)), float(min(width, height))
    low, high = SENSOR_SHAPES
    if not low <= longer / shorter <= high:
        # Phones state the focal length of the whole sensor, whichever part of it a picture shows.
        longer, shorter = max(longer, 4 / 3 * shorter), max(shorter, 3 / 4 * longer)
    return film * float(np.hypot(longer, shorter)) / FULL_FRAME_DIAGONAL if film else None


def _was_cut(exif: dict[int, Any], width: int, height: int) -> bool:
    """Whether the picture has another shape than the one that was taken, which may have been turned since.

    What is left of it has another focal length in sides, and its principal point is no longer in the middle.
    """
    taken = int(exif.get(ExifTags.Base.ExifImageWidth, 0)), int(exif.get(ExifTags.Base.ExifImageHeight, 0))
    shorter, longer = sorted(taken)
    return shorter > 0 and not same_shape((shorter, longer), (min(width, height), max(width, height)))


def _focal_from_sensor(exif: dict[int, Any], width: int, height: int) -> float | None:
    """Focal length times the sensor's pixels per millimetre; the file may have been reduced or turned since.

    Some cameras state the density along one side only. Both are those of the lens and the sensor, so digital zoom comes
    on top; 35 mm equivalents of phones have it already.
    """
    millimetres = float(exif.get(ExifTags.Base.FocalLength, 0))
    unit = MILLIMETRES[int(exif.get(ExifTags.Base.FocalPlaneResolutionUnit, 2))]
    densities = (exif.get(tag, 0) for tag in (ExifTags.Base.FocalPlaneXResolution, ExifTags.Base.FocalPlaneYResolution))
    density = next(filter(None, map(float, densities)), 0.0)
    stated = float(exif.get(ExifTags.Base.ExifImageWidth, 0)), float(exif.get(ExifTags.Base.ExifImageHeight, 0))
    sides = [(full, pixels) for full, pixels in zip(stated, (width, height), strict=True) if full]
    # The longer sides belong together, also where a program turned the pixels and left the entries.
    scale = max(pixels for _, pixels in sides) / max(full for full, _ in sides) if sides else 1.0
    zoom = max(1.0, float(exif.get(ExifTags.Base.DigitalZoomRatio, 1)))  # 0 says that there was none
    return millimetres * density / unit * scale * zoom or None
