"""What EXIF says about a photo."""

import re
from dataclasses import dataclass
from typing import Any

import numpy as np
from PIL import ExifTags, Image

FULL_FRAME_DIAGONAL = 43.2666
"""Millimetres: FocalLengthIn35mmFilm is the focal length that has the same diagonal field of view on 36 × 24."""
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
        focal = _focal_from_film(exif, width, height) or _focal_from_sensor(exif, width, height)
    except (ValueError, TypeError, ZeroDivisionError, KeyError, SyntaxError, OSError):
        return None
    low, high = SENSIBLE_FOCAL
    return focal if focal and low < focal / max(width, height) < high else None


def says_panorama(image: Image.Image) -> bool:
    """Whether XMP says that the picture shows 360° (GPano:ProjectionType, Google's photo sphere metadata)."""
    packet = image.info.get("xmp", b"")
    text = packet if isinstance(packet, bytes) else str(packet).encode(errors="replace")
    return re.search(rb"GPano:ProjectionType(=[\"']|>)\s*equirectangular", text) is not None


def _focal_from_film(exif: dict[int, Any], width: int, height: int) -> float | None:
    film = float(exif.get(ExifTags.Base.FocalLengthIn35mmFilm, 0))
    return film * float(np.hypot(width, height)) / FULL_FRAME_DIAGONAL if film else None


def _focal_from_sensor(exif: dict[int, Any], width: int, height: int) -> float | None:
    """Focal length times the sensor's pixels per millimetre; the file may have been reduced after it was taken.

    Some cameras state the density along one side only.
    """
    millimetres = float(exif.get(ExifTags.Base.FocalLength, 0))
    unit = MILLIMETRES[int(exif.get(ExifTags.Base.FocalPlaneResolutionUnit, 2))]
    sides = (
        (ExifTags.Base.FocalPlaneXResolution, ExifTags.Base.ExifImageWidth, width),
        (ExifTags.Base.FocalPlaneYResolution, ExifTags.Base.ExifImageHeight, height),
    )
    for density_tag, full_tag, pixels in sides:
        density = float(exif.get(density_tag, 0))
        if millimetres and density:
            return millimetres * density / unit * pixels / (float(exif.get(full_tag, 0)) or pixels)
    return None
