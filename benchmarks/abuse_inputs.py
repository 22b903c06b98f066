"""Sound files for `abuse.py` to damage, and ways to damage them. Everything is repeatable from a seed."""

import io
import json
import random
import shutil
import struct
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from PIL import Image
from safetensors.torch import load_file, save_file

from querysplat_cli.cli import run
from querysplat_cli.scene.formats.colmap import write_colmap
from querysplat_cli.scene.formats.compressed import write_spz
from querysplat_cli.scene.formats.ply import write_ply
from querysplat_cli.scene.formats.transforms import read_transforms
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.training.photographer import cast, walk
from querysplat_cli.training.rooms import make_room

REFUSED = frozenset({2, 3, 4})
ANY = REFUSED | {0}


@dataclass(frozen=True)
class Case:
    """One hostile input.

    `make(folder)` writes it into an empty folder. `command` is what then runs there. `codes` are the exit codes that
    are right. `written` are the names that a finished command may leave. `kind` says how it runs: in this process
    ("call"), in a process of its own with `place` around it ("process"), or killed after `place` ("kill").
    """

    family: str
    what: str
    make: Callable[[Path], object]
    command: tuple[str, ...]
    codes: frozenset[int] = ANY
    written: tuple[str, ...] = ("out", "out.ply", "out.json", "s", "s.ply")
    kind: str = "call"
    place: dict[str, Any] = field(default_factory=dict)


class Sound:
    """A folder of sound files: a scene, photos, cameras, every kind of Gaussians."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.photos = folder / "photos"
        scene = make_room(3)
        cameras = walk(scene, 2, 3)
        self.photos.mkdir(parents=True)
        for i in range(2):
            picture = (cast(scene, cameras[[i]], samples=1)[0][0] * 255).byte().permute(1, 2, 0).numpy()
            cv2.imwrite(str(self.photos / f"{i}.png"), picture[..., ::-1])
        made = ["reconstruct", str(self.photos / "0.png"), "-o", str(folder / "s.ply"), "--max-size", "96", "-q"]
        assert run([*made, "--tto", "1"]) == 0
        assert run(["convert", str(folder / "s" / "cameras.json"), str(folder / "transforms.json"), "-q"]) == 0
        few = gaussians(20)
        write_ply(folder / "few.ply", few)
        write_spz(folder / "few.spz", few)
        write_sog(folder / "few.sog", 20)
        listed = read_transforms(folder / "transforms.json")
        for text in (False, True):
            place = folder / ("text" if text else "binary")
            place.mkdir()
            write_colmap(place, listed, text=text)
        self.captured = folder / "captured"
        (self.captured / "images").mkdir(parents=True)
        pixels = np.random.default_rng(0).integers(0, 255, (64, 80, 3), dtype=np.uint8)
        for i in range(40):
            cv2.imwrite(str(self.captured / "images" / f"{i}.png"), np.roll(pixels, i))

    def bytes(self, name: str) -> bytes:
        return (self.folder / name).read_bytes()

    def scene(self, target: Path) -> None:
        """A copy of the scene, as s.ply and s/."""
        shutil.copy(self.folder / "s.ply", target / "s.ply")
        shutil.copytree(self.folder / "s", target / "s")


def gaussians(count: int) -> Gaussians:
    generator = torch.Generator().manual_seed(0)
    normal = [torch.randn(count, *shape, generator=generator) for shape in ((3,), (4,), (3,), (), (4, 3))]
    return Gaussians(normal[0], normal[1], (normal[2] - 3).exp(), normal[3].sigmoid(), normal[4])


def write_sog(path: Path, count: int) -> None:
    """A small .sog of random numbers, version 2: textures in a zip."""
    side = 8
    rng = np.random.default_rng(0)
    meta = {
        "version": 2, "count": count, "antialias": False,
        "means": {"mins": [-1, -1, -1], "maxs": [1, 1, 1], "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": np.linspace(-6, -1, 256).tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": np.linspace(-1, 1, 256).tolist(), "files": ["sh0.webp"]},
    }  # fmt: skip
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("meta.json", json.dumps(meta))
        for name in ("means_l", "means_u", "scales", "quats", "sh0"):
            pixels = rng.integers(0, 255, (side, side, 4), dtype=np.uint8)
            pixels[..., 3] = 252 if name == "quats" else 255
            stream = io.BytesIO()
            Image.fromarray(pixels, "RGBA").save(stream, "WEBP", lossless=True, exact=True)
            archive.writestr(f"{name}.webp", stream.getvalue())


def damaged(sound: bytes, name: str, flips: int, cuts: int, *, head: int | None = None) -> Iterator[tuple[str, bytes]]:
    """The bytes with one to eight of them changed, half of the times within the first `head`; and cut off."""
    for i in range(flips):
        rng = random.Random(f"{name} {i}")
        changed = bytearray(sound)
        reach = min(len(sound), head or len(sound)) if i % 2 else len(sound)
        for _ in range(rng.randint(1, 8)):
            changed[rng.randrange(reach)] = rng.randrange(256)
        yield f"bytes changed, {i}", bytes(changed)
    for i in range(cuts):
        yield f"cut to {i} of {cuts} parts", sound[: len(sound) * i // cuts]


def noise(name: str, count: int) -> Iterator[tuple[str, bytes]]:
    """Random bytes, 0 to 4,000 of them."""
    for i in range(count):
        rng = random.Random(f"{name} noise {i}")
        yield f"random bytes, {i}", rng.randbytes(rng.randrange(4000))


VALUES: tuple[Any, ...] = (
    0, -111, 1e-300, 1e30, 10**400, float("nan"), float("inf"), 2**63, True, None, "", "x", "9" * 50,
    [], {}, [[]], "\ud800", "../../etc/passwd", ".", "..", "/", "a\0b",
)  # fmt: skip
"""What a value in a JSON file is replaced by. Each of them is wrong for most values."""


def places(content: Any, way: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The way to every value in JSON content; of long lists only the first two."""
    if isinstance(content, dict):
        for key, value in content.items():
            yield (*way, key)
            yield from places(value, (*way, key))
    elif isinstance(content, list):
        for key, value in enumerate(content[:2]):
            yield (*way, key)
            yield from places(value, (*way, key))


def changed_json(sound: bytes, name: str, count: int) -> Iterator[tuple[str, bytes]]:
    """One value replaced, or removed, or a key renamed; and nesting, digits and repetition."""
    content = json.loads(sound)
    ways = list(places(content))
    for i in range(count):
        rng = random.Random(f"{name} json {i}")
        way, value = rng.choice(ways), rng.choice((*VALUES, "remove", "rename"))
        copy = json.loads(sound)
        inner = copy
        for key in way[:-1]:
            inner = inner[key]
        if value == "remove":
            del inner[way[-1]]
        elif value == "rename" and isinstance(inner, dict):
            inner[f"{way[-1]}?"] = inner.pop(way[-1])
        else:
            inner[way[-1]] = value
        yield f"{'.'.join(map(str, way))} = {ascii(value)[:30]}", json.dumps(copy).encode()
    yield "nested 100,000 times", b"[" * 100_000
    yield "objects nested 100,000 times", b'{"a":' * 100_000
    yield "a number of 5,000 digits", b'{"frames": [' + b"9" * 5000 + b"]}"
    yield "not UTF-8", sound.replace(b"a", b"\xff")
    yield "UTF-16", sound.decode().encode("utf-16")
    yield "an empty file", b""
    yield "null", b"null"


def changed_tensors(file: Path, count: int) -> Iterator[tuple[str, Callable[[Path], object]]]:
    """One tensor of a safetensors file with another shape, type, range, or without it."""
    names = sorted(load_file(file))
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
        "huge": lambda t: torch.full_like(t, 2**30) if t.dtype != torch.bool else ~t,
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
            save_file(tensors, target, metadata={"model": "compact"})

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
        ifd = tags.get_ifd(0x8769)
        ifd.update(
            {tag: value if not isinstance(value, tuple) else value[0] / value[1] for tag, value in inner.items()}
        )
        stream = io.BytesIO()
        pixels.save(stream, "JPEG", exif=tags)
        content = bytearray(stream.getvalue())
        for _ in range(rng.randint(0, 6)):
            content[rng.randrange(2, 200)] = rng.randrange(256)
        yield f"EXIF {i}", bytes(content)


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
