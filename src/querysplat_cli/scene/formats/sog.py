"""PlayCanvas's SOG, version 2: a scene as lossless WebP pictures and a meta.json, zipped.

A Gaussian is a pixel of every picture. Its centre has 16 bits a coordinate, of sign(x)·ln(1 + |x|); its rotation three
bytes; scales, colours and SH are entries of codebooks; opacity is a byte. Axes are those of the .ply. Where the
format's text and PlayCanvas's code differ, this follows the code: scale codebooks hold logarithms, and a quaternion
whose alpha is 252 is without its w.
"""

import io
import json
import math
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.files import atomic_path
from querysplat_cli.scene.formats.palettes import codebook, nearest, palette
from querysplat_cli.scene.formats.ply import HIGHEST_OPACITY, damage_named, finite_gaussians
from querysplat_cli.scene.gaussians import Gaussians

VERSION = 2
LARGEST_COMPONENT = 252
"""Alpha of a rotation whose w is the component left out; 253 to 255 are x, y and z."""
PALETTE_COLUMNS = 64
MOST_PALETTES = 64
"""A palette has at most so many times 1,024 entries."""
MOST_PIXELS = 1 << 28
FIXED_TIME = (1980, 1, 1, 0, 0, 0)
"""Zip entries have this time, so that the same scene gives the same bytes."""


def write_sog(path: Path, gaussians: Gaussians) -> int:
    """Write the finite Gaussians, in their order; returns how many there are."""
    finite = finite_gaussians(path, gaussians)
    meta, pictures = encoded(finite)
    with atomic_path(path) as draft, zipfile.ZipFile(draft, "w") as archive:
        archive.writestr(zipfile.ZipInfo("meta.json", FIXED_TIME), json.dumps(meta))
        for name, pixels in pictures.items():
            archive.writestr(zipfile.ZipInfo(name, FIXED_TIME), webp(pixels))
    return len(finite)


def read_sog(path: Path) -> Gaussians:
    """The Gaussians of a .sog of version 2. Raises QuerySplatError when it is damaged, or of another version."""
    with damage_named(path, ".sog"), zipfile.ZipFile(path) as archive:
        meta = json.loads(archive.read("meta.json"))
        if meta.get("version") != VERSION:
            raise QuerySplatError(f"{path}: SOG version {meta.get('version', 1)} is not read", "Export version 2.")
        gaussians = decoded(meta, lambda name: unpacked(archive.read(name)))
    return finite_gaussians(path, gaussians)


def encoded(gaussians: Gaussians) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The meta.json, and the pictures [height, width, 4] by file name."""
    means = gaussians.means.double().numpy()
    logs = np.sign(means) * np.log1p(np.abs(means))
    low, high = logs.min(0), logs.max(0)
    fixed = np.rint((logs - low) / np.maximum(high - low, 1e-30) * 65535).astype(np.int64)
    scales, scale_book = _coded(gaussians.scales.clamp_min(1e-30).log().double().numpy())
    colours, colour_book = _coded(gaussians.sh[:, 0].double().numpy())
    alpha = np.rint(gaussians.opacities.double().numpy() * 255)[:, None]
    pictures = {
        "means_l.webp": _picture(fixed & 255),
        "means_u.webp": _picture(fixed >> 8),
        "quats.webp": _picture(_packed_quats(gaussians.quats.double().numpy())),
        "scales.webp": _picture(scales),
        "sh0.webp": _picture(np.concatenate([colours, alpha], 1)),
    }
    meta: dict[str, Any] = {
        "version": VERSION,
        "count": len(gaussians),
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scale_book, "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": colour_book, "files": ["sh0.webp"]},
    }
    if gaussians.sh_degree:
        meta["shN"], bands = _encoded_bands(gaussians)
        pictures |= bands
    return meta, pictures


def _encoded_bands(gaussians: Gaussians) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    count, bands = len(gaussians), gaussians.sh.shape[1] - 1
    most = max(1, int(min(MOST_PALETTES, 2.0 ** math.floor(math.log2(count / 1024))) * 1024))
    # float64 throughout: the same scene gives the same palette.
    centres, labels = palette(gaussians.sh[:, 1:].double().numpy().reshape(count, -1), most)
    entries, book = _coded(centres.astype(np.float64))
    rows = -(-len(centres) // PALETTE_COLUMNS)
    pixels = np.zeros((rows * PALETTE_COLUMNS, bands, 4), np.uint8)
    pixels[..., 3] = 255
    pixels[: len(centres), :, :3] = entries.reshape(len(centres), bands, 3)
    files = {
        "shN_centroids.webp": pixels.reshape(rows, PALETTE_COLUMNS * bands, 4),
        "shN_labels.webp": _picture(np.stack([labels & 255, labels >> 8, 0 * labels], 1)),
    }
    meta = {"count": len(centres), "bands": gaussians.sh_degree, "codebook": book, "files": list(files)}
    return meta, files


def decoded(meta: dict[str, Any], picture: Callable[[str], np.ndarray]) -> Gaussians:
    """The opposite of `encoded`; `picture` gives the pixels of a file name. Damage can raise anything."""
    count = int(meta["count"])

    def pixels(part: str, file: int = 0) -> np.ndarray:
        found = picture(meta[part]["files"][file]).reshape(-1, 4)
        if len(found) < count:
            raise ValueError(f"{part} has fewer pixels than there are Gaussians")
        return found[:count].astype(np.int64)

    low, high = (np.array(meta["means"][key], np.float64) for key in ("mins", "maxs"))
    logs = low + (high - low) * (pixels("means")[:, :3] + 256 * pixels("means", 1)[:, :3]) / 65535
    colours = pixels("sh0")
    sh = np.array(meta["sh0"]["codebook"], np.float64)[colours[:, :3]][:, None]
    if "shN" in meta:
        bands = (int(meta["shN"]["bands"]) + 1) ** 2 - 1
        labels = pixels("shN", 1)
        palette_pixels = picture(meta["shN"]["files"][0]).reshape(-1, bands, 4)
        entries = np.array(meta["shN"]["codebook"], np.float64)[palette_pixels[..., :3].astype(np.int64)]
        sh = np.concatenate([sh, entries[labels[:, 0] + 256 * labels[:, 1]]], 1)
    scales = np.exp(np.array(meta["scales"]["codebook"], np.float64)[pixels("scales")[:, :3]])
    parts = (
        np.sign(logs) * np.expm1(np.abs(logs)),
        _unpacked_quats(pixels("quats")),
        scales,
        colours[:, 3] / 255,
        sh,
    )
    means, quats, sizes, opacities, bands_of = (torch.from_numpy(part.astype(np.float32)) for part in parts)
    return Gaussians(means, quats, sizes, opacities.clamp(1e-8, HIGHEST_OPACITY), bands_of)


def _coded(values: np.ndarray) -> tuple[np.ndarray, list[float]]:
    """Entries of a codebook of 256 for the values, and the codebook."""
    book = codebook(values)
    entries = nearest(values, book)
    return entries, [float(value) for value in np.pad(book, (0, 256 - len(book)), mode="edge")]


def _packed_quats(quats: np.ndarray) -> np.ndarray:
    """The three smaller components, from −1/√2 to 1/√2, and which one is missing."""
    unit = quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-30)
    largest = np.abs(unit).argmax(1)
    unit = unit * np.where(unit[np.arange(len(unit)), largest] < 0, -1, 1)[:, None]
    rest = unit[np.arange(4) != largest[:, None]].reshape(-1, 3)
    bytes_ = np.rint((rest * math.sqrt(2) + 1) / 2 * 255).clip(0, 255)
    return np.concatenate([bytes_, LARGEST_COMPONENT + largest[:, None]], 1)


def _unpacked_quats(pixels: np.ndarray) -> np.ndarray:
    rest = (pixels[:, :3] / 255 * 2 - 1) / math.sqrt(2)
    largest = (pixels[:, 3] - LARGEST_COMPONENT).clip(0, 3)
    quats = np.zeros((len(pixels), 4))
    quats[np.arange(4) != largest[:, None]] = rest.ravel()
    quats[np.arange(len(pixels)), largest] = np.sqrt(np.maximum(1 - (rest**2).sum(1), 0))
    return quats


def _picture(values: np.ndarray) -> np.ndarray:
    """Values [n, 3 or 4] as a picture whose sides are multiples of 4, filled up with zeros; opaque without a fourth."""
    width = math.ceil(math.sqrt(len(values)) / 4) * 4
    height = math.ceil(len(values) / width / 4) * 4
    pixels = np.zeros((height * width, 4), np.uint8)
    pixels[:, 3] = 255
    pixels[: len(values), : values.shape[1]] = values
    return pixels.reshape(height, width, 4)


def webp(pixels: np.ndarray) -> bytes:
    """A picture [height, width, 4] as a lossless WebP."""
    stream = io.BytesIO()
    # Without `exact`, colours under an alpha of 0 are lost.
    Image.fromarray(pixels, "RGBA").save(stream, "WEBP", lossless=True, exact=True)
    return stream.getvalue()


def unpacked(content: bytes) -> np.ndarray:
    """The picture [height, width, 4] in a WebP. Raises ValueError when it is something else."""
    with Image.open(io.BytesIO(content)) as image:
        if image.format != "WEBP" or image.width * image.height > MOST_PIXELS:
            raise ValueError("a picture of it is no WebP of a sensible size")
        return np.asarray(image.convert("RGBA"))
