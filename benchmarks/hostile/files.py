"""Damaged files of Gaussians and of cameras."""

from collections.abc import Callable, Iterator
from pathlib import Path

from hostile.case import QUIET, Case, one_file
from hostile.damage import changed_json, damaged, drawn_json, drawn_ply, noise
from hostile.damage_formats import headers
from hostile.scenes import in_scene
from hostile.sound import Sound


def gaussians(sound: Sound) -> Iterator[Case]:
    command = ("convert", "in.ply", "out.ply", QUIET)
    ply = sound.bytes("few.ply")
    for what, content in (*headers(ply), *damaged(ply, "ply", 60, 20, head=900), *noise("ply", 10)):
        yield Case("PLY", what, one_file("in.ply", content), command)
    for what, content in drawn_ply(60):
        yield Case("PLY by hypothesis", what, one_file("in.ply", content), command)
    made = ("convert", "in.compressed.ply", "out.ply", QUIET)
    for what, content in (("a .ply", ply), *damaged(ply, "compressed", 4, 4), *noise("compressed", 2)):
        yield Case("PLY", f".compressed.ply, {what}", one_file("in.compressed.ply", content), made)
    for kind, family in (("spz", "SPZ"), ("sog", "SOG"), ("glb", "glTF")):
        convert = ("convert", f"in.{kind}", "out.ply", QUIET)
        found = sound.bytes(f"few.{kind}")
        for what, content in (*damaged(found, kind, 60, 20, head=60), *noise(kind, 10)):
            yield Case(family, what, one_file(f"in.{kind}", content), convert)


def cameras(sound: Sound) -> Iterator[Case]:
    listing = sound.bytes("transforms.json")
    command = ("convert", "in.json", "out.json", QUIET)
    for what, content in (*changed_json(listing, "transforms", 120), *damaged(listing, "transforms", 20, 10)):
        yield Case("transforms.json", what, one_file("in.json", content), command)
    for what, content in drawn_json(listing, 60):
        yield Case("JSON by hypothesis", f"cameras, {what}", one_file("in.json", content), command)
    stored = sound.bytes("s/cameras.json")
    for what, content in changed_json(stored, "cameras", 60):
        yield in_scene(sound, "cameras.json", what, "cameras.json", content, ("tto", "s", "--steps", "0", QUIET))
    for what, content in changed_json(stored, "frames", 30):
        command = ("render", "s.ply", "-o", "out", "--size", "16x12", QUIET)
        yield in_scene(sound, "cameras.json, rendered", what, "cameras.json", content, command)
    for form, suffix in (("text", "txt"), ("binary", "bin")):
        for part in ("cameras", "images", "points3D"):
            whole = sound.bytes(f"{form}/{part}.{suffix}")
            for what, content in damaged(whole, f"{form} {part}", 25, 8):
                model = _model(sound, form, f"{part}.{suffix}", content)
                yield Case(f"COLMAP, {form}", f"{part}: {what}", model, ("convert", "model", "out.json", QUIET))


def _model(sound: Sound, form: str, name: str, content: bytes) -> Callable[[Path], object]:
    def write(folder: Path) -> None:
        (folder / "model").mkdir()
        for file in (sound.folder / form).iterdir():
            (folder / "model" / file.name).write_bytes(content if file.name == name else file.read_bytes())

    return write
