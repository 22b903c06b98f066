"""Lies that only one kind of file can hold. Everything is repeatable from a seed."""

import contextlib
import io
import random
import struct
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

from hostile.damage import damaged

import cv2
import numpy as np
import torch
from PIL import Image
from safetensors import safe_open
from safetensors.torch import load_file, save_file


def changed_tensors(file: Path, count: int) -> Iterator[tuple[str, Callable[[Path], object]]]:
    """One tensor of a safetensors file with another shape, type, range, or without it."""
    names = sorted(load_file(file))
    with safe_open(file, "pt") as opened:
        metadata = opened.metadata()
    changes: dict[str, Callable[[torch.Tensor], torch.Tensor]] = {
        "halved": lambda t: t[: len(t) // 2],
        "doubled": lambda t: torch.cat([t, t]),
        "empty": lambda t: t[:0],
        "one axis more": lambda t: t[..., None],
        "one axis less": lambda t: t.flatten()[: max(1, len(t))],
        "int64": lambda t: t.long(),
        "float16": lambda t: t.half(),
        "bool": lambda t: t.bool(),
        "NaN": lambda t: torch.full_like(t, torch.nan) if t.is_floating_point() else t.float() * torch.nan,
        "infinite": lambda t: torch.full_like(t, torch.inf) if t.is_floating_point() else t.double() * torch.inf,
        "huge": lambda t: t.new_full(t.shape, {torch.half: 2**15, torch.uint8: 255}.get(t.dtype, 2**30)),
        "negative": lambda t: -t - 1 if t.dtype != torch.bool else ~t,
        "last axis cut": lambda t: t[..., :-1],
    }

    def make(name: str, change: str) -> Callable[[Path], object]:
        def write(target: Path) -> None:
            tensors = load_file(file)
            if change == "missing":
                del tensors[name]
            else:
                tensors[name] = changes[change](tensors[name]).contiguous()
            save_file(tensors, target, metadata=metadata)

        return write

    every = [(name, change) for name in names for change in (*changes, "missing")]
    random.Random("tensors").shuffle(every)
    for name, change in every[:count]:
        yield f"{name}: {change}", make(name, change)


def headers(sound: bytes) -> Iterator[tuple[str, bytes]]:
    """A .ply whose header lies."""
    for count in ("-1", "0", "1", "21", "4294967296", "9223372036854775808", "1e30", "nan", "x", "9" * 5000, ""):
        yield f"element vertex {count[:22]}", sound.replace(b"element vertex 20", b"element vertex " + count.encode())
    for old, new in (
        ("property float x", "property list uchar float x"),
        ("property float opacity", "property list int double opacity"),
        ("property float f_rest_0", "property float f_rest_99"),
        ("property float f_rest_8\n", ""),
        ("property float x\n", "property float y\n"),
        ("property float x\n", ""),
        ("property float", "property double"),
        ("property float", "property uchar"),
        ("property float", "property nonsense"),
        ("binary_little_endian", "ascii"),
        ("binary_little_endian", "binary_big_endian"),
        ("binary_little_endian", "binary_middle_endian"),
        ("end_header", "end_headers"),
        ("element vertex", "element face"),
        ("element vertex", "element vertex 3\nproperty list uchar int a\nelement vertex"),
        ("ply\n", "ply" + "y" * 100_000 + "\n"),
        ("ply\n", "ply\ncomment " + "c" * 100_000 + "\n"),
    ):
        yield f"{old.strip()} → {new.strip()[:40]}", sound.replace(old.encode(), new.encode())
    body = sound.index(b"end_header\n") + len(b"end_header\n")
    for value in (float("nan"), float("inf"), -float("inf"), 3e38, 0.0):
        filled = struct.pack("<f", value) * ((len(sound) - body) // 4)
        yield f"every number {value}", sound[:body] + filled


def exif(count: int) -> Iterator[tuple[str, bytes]]:
    """JPEGs of 128 × 96 pixels with absurd EXIF."""
    pixels = Image.fromarray(np.random.default_rng(0).integers(0, 255, (96, 128, 3), dtype=np.uint8))
    for i in range(count):
        rng = random.Random(f"exif {i}")
        tags = Image.Exif()
        inner = {
            0x9209: rng.choice((0, 9)), 0x920A: rng.choice(((0, 1), (2**32 - 1, 1), (35, 1))),
            0xA405: rng.choice((0, 65535, 28)), 0xA20E: rng.choice(((0, 1), (1, 1), (5000, 1))),
            0xA210: rng.choice((0, 1, 3, 9, 65535)), 0xA002: rng.choice((0, 2**32 - 1, 80)),
        }  # fmt: skip
        tags[0x0112] = rng.choice((0, 1, 3, 6, 8, 9, 65535))
        tags[0x8769] = {
            tag: value if not isinstance(value, tuple) else value[0] / max(value[1], 1e-9)
            for tag, value in inner.items()
        }
        stream = io.BytesIO()
        pixels.save(stream, "JPEG", exif=tags)
        content = bytearray(stream.getvalue())
        for _ in range(rng.randint(0, 6)):
            content[rng.randrange(2, 200)] = rng.randrange(256)
        yield f"EXIF {i}", bytes(content)


def gps(picture: Path, count: int) -> Iterator[tuple[str, bytes]]:
    """The picture with absurd places in its EXIF."""
    pixels = Image.open(picture).convert("RGB").resize((160, 120))
    for i in range(count):
        yield f"places {i}", _with_place(pixels, random.Random(f"gps {i}"))


def _with_place(pixels: Image.Image, rng: random.Random) -> bytes:
    """A PNG with a place, two of three times a sensible one but for one entry."""
    wild = (0.0, 7.0, -1e9, 1e9, 999.0, float("nan"), float("inf"))
    sensible = {1: "N", 2: (47.0, 5.0, rng.random()), 3: "E", 4: (8.0, 30.0, rng.random()), 5: b"\0", 6: 400.0}
    odd = {rng.choice((2, 4)): tuple(rng.choice(wild) for _ in range(rng.choice((1, 3, 4)))), 6: rng.choice(wild)}
    entries = {**sensible, **(odd if rng.random() < 0.33 else {rng.randint(1, 6): rng.choice((*wild, "x", b"\xff"))})}
    for kept in (entries, sensible):
        tags, stream = Image.Exif(), io.BytesIO()
        tags[0x8825] = kept
        with contextlib.suppress(Exception):  # Pillow does not write everything
            pixels.save(stream, "PNG", exif=tags)
            return stream.getvalue()
    raise AssertionError("a sensible place can be written")


def masks(mask: np.ndarray) -> Iterator[tuple[str, bytes]]:
    """Masks that leave nothing or little, of other sizes, kinds and depths."""
    small = np.zeros_like(mask)
    small[:3, :3] = 255
    shapes = {
        "sound": mask, "all black": mask * 0, "all white": mask * 0 + 255, "of nine pixels": small,
        "transposed": mask.T, "half as large": mask[::2, ::2], "one pixel": mask[:1, :1], "one row": mask[:1],
        "of 16 bits": mask.astype(np.uint16) * 257, "in colour": np.stack([mask, mask * 0, mask], -1),
        "with alpha": np.stack([mask] * 4, -1), "nearly black": mask // 255,
        "stripes": mask * (np.arange(mask.shape[1]) % 2),
    }  # fmt: skip
    for what, pixels in shapes.items():
        yield (
            what,
            cv2.imencode(".png", pixels.astype(pixels.dtype if pixels.dtype == np.uint16 else np.uint8))[1].tobytes(),
        )


def zips(captured: Path, count: int) -> Iterator[tuple[str, bytes]]:
    """A zip of a captured scene: damaged, with names that leave it, and with a bomb in place of its cameras."""

    def packed(extra: dict[str, bytes]) -> bytes:
        stream = io.BytesIO()
        with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
            for file in sorted((captured / "images").iterdir()):
                archive.write(file, f"z/images/{file.name}")
            for name, content in extra.items():
                archive.writestr(name, content)
        return stream.getvalue()

    yield from damaged(packed({}), "zip", count, count // 4)
    yield "names that leave it", packed({"../../../evil.png": b"x", "/etc/evil.png": b"x", "z/images/..": b"x"})
    yield "a bomb of zeros", packed({"z/transforms.json": bytes(1 << 26)})
    yield "a nested listing", packed({"z/transforms.json": b"[" * 100_000})
    yield "a COLMAP model of noise", packed({"z/sparse/0/images.bin": random.Random(0).randbytes(999)})
