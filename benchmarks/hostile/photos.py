"""Damaged pictures, films, masks, places and weights."""

from collections.abc import Callable, Iterator
from pathlib import Path

import querysplat_cli
from hostile.case import QUIET, REFUSED, Case, one_file, several
from hostile.damage import damaged, noise
from hostile.damage_formats import changed_tensors, exif, gps, masks
from hostile.sound import Sound

import cv2
import numpy as np

PRESET = Path(querysplat_cli.__file__).parent / "weights" / "compact.safetensors"
SMALL = ("--tto", "0", "--max-size", "96", "--quality", "draft", "-o", "out.ply", QUIET)


def pictures(sound: Sound) -> Iterator[Case]:
    """A damaged picture beside its camera: `convert --photos` reads and straightens it."""
    pixels = cv2.imread(str(sound.photos / "0.png"))
    inputs = []
    for suffix in ("png", "jpg", "tif", "webp", "bmp"):
        whole = cv2.imencode(f".{suffix}", pixels)[1].tobytes()
        inputs += [(f"{suffix}: {what}", found) for what, found in damaged(whole, suffix, 16, 4, head=200)]
    inputs += [*exif(40), *noise("picture", 10)]
    for what, content in inputs:

        def write(folder: Path, content: bytes = content) -> None:
            (folder / "photos").mkdir()
            (folder / "photos" / "0.png").write_bytes(content)
            (folder / "in.json").write_bytes(sound.bytes("transforms.json"))

        family = "EXIF" if what.startswith("EXIF") else "pictures"
        yield Case(family, what, write, ("convert", "in.json", "out", "--photos", "photos", QUIET))


def photos(sound: Sound) -> Iterator[Case]:
    """Damaged films, masks, places and weights, of which `reconstruct` makes a small scene."""
    film = sound.bytes("film.mp4")
    renamed = {"in.mov": film, "in.jpg": film, "in.webm": film, "in.mp4": sound.bytes("photos/0.png"), "in.m4v": b""}
    inputs = [("in.mp4", what, content) for what, content in damaged(film, "film", 30, 10, head=400)]
    inputs += [("in.mp4", what, content) for what, content in noise("film", 6)]
    inputs += [(name, f"renamed to {name}", content) for name, content in renamed.items()]
    for name, what, content in inputs:
        yield Case("films", what, one_file(name, content), ("reconstruct", name, "--frames", "2", *SMALL))
    mask = cv2.imencode(".png", np.full((480, 640), 255, np.uint8))[1].tobytes()
    wrong = np.zeros((480, 640), np.uint8)
    wrong[100:400, 100:500] = 255
    for what, content in (*masks(wrong), *damaged(mask, "mask", 12, 4, head=60), *noise("mask", 3)):
        write = several({"p/0.png": sound.bytes("photos/0.png"), "p/masks/0.png": content})
        yield Case("masks", what, write, ("reconstruct", "p", *SMALL))
    # One photo cannot give metres, which is found after its place was read. The fit of several has tests of its own.
    for what, content in gps(sound.photos / "0.png", 40):
        yield Case("GPS", what, one_file("0.png", content), ("reconstruct", "0.png", "--scale", "gps", *SMALL), REFUSED)


def weights(sound: Sound) -> Iterator[Case]:
    """Damaged checkpoints, as a preset and as downloaded files."""
    photo = str(sound.photos / "0.png")
    command = ("reconstruct", photo, "--preset", "w.safetensors", *SMALL)
    for what, content in (*damaged(PRESET.read_bytes(), "weights", 20, 6, head=4000), *noise("weights", 4)):
        yield Case("weights", what, one_file("w.safetensors", content), command)
    for what, change in changed_tensors(PRESET, 60):

        def alter(folder: Path, change: Callable[[Path], object] = change) -> None:
            change(folder / "w.safetensors")

        yield Case("weights", what, alter, command)
    for what, content in (*noise("downloaded", 6), ("nothing", b""), ("a header of 2^60 bytes", b"\0" * 7 + b"\x10{}")):
        files = {"d/model.safetensors": content, "d/vggt_omega_1b_512.pt": content}
        yield Case("weights", f"downloaded, {what}", several(files), ("weights", "--weights", "d", "--verify", QUIET))
