"""Damaged scene folders, settings, split files and zips of scenes."""

import json
import random
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path

from hostile.case import ANY, QUIET, REFUSED, WRITTEN, Case, one_file, several
from hostile.damage import changed_json, damaged, drawn_json, noise, places
from hostile.damage_formats import changed_tensors, zips
from hostile.sound import TRAINING, Sound

LISTS = ("cameras.json", "report.json", "photos.json")
NINES = "9" * 5000
TOML = TRAINING.encode()
TOML_VALUES = ("0", "-111", "1e-300", "1e30", "nan", "inf", "9223372036854775808", "true", '""', "'x'", "[]", "{}")
TOML_VALUES += ("[[]]", "'../../etc/passwd'", "1979-05-27", "x", "", '"\\ud800"', "[1, 1e99]", "{a = {b = 1}}")


def in_scene(
    sound: Sound,
    family: str,
    what: str,
    part: str,
    content: bytes | Callable[[Path], object],
    command: tuple[str, ...],
    written: tuple[str, ...] = WRITTEN,
) -> Case:
    """`command` on the scene s/ with `content` in place of one of its files."""

    def write(folder: Path) -> None:
        sound.scene(folder)
        target = folder / "s" / part
        if callable(content):
            content(target)
        else:
            target.write_bytes(content)

    return Case(family, what, write, command, ANY, written)


def scene_folder(sound: Sound) -> Iterator[Case]:
    again = ("tto", "s", "--steps", "1", QUIET)
    memories = sound.folder / "s" / "memories.safetensors"
    for what, change in changed_tensors(memories, 150):
        yield in_scene(sound, "memories", what, memories.name, change, again)
    for what, content in damaged(memories.read_bytes(), "memories", 30, 10, head=3000):
        yield in_scene(sound, "memories", what, memories.name, content, again)
    for part in LISTS:
        for what, content in drawn_json(sound.bytes(f"s/{part}"), 25):
            text = f"{part}, {what}"
            yield in_scene(sound, "JSON by hypothesis", text, part, content, ("tto", "s", "--steps", "0", QUIET))
    for part, count in (("report.json", 80), ("photos.json", 30)):
        for what, content in changed_json(sound.bytes(f"s/{part}"), part, count):
            yield in_scene(sound, part, what, part, content, ("tto", "s", "--steps", "0", QUIET))
    yield from _exposures(sound)
    yield from _points(sound)
    for what, content in damaged(sound.bytes("s/images/0.png"), "image", 10, 5, head=60):
        yield in_scene(sound, "a scene's pictures", what, "images/0.png", content, again)


def shown(sound: Sound) -> Iterator[Case]:
    """A damaged scene, looked at: `info`, `export`, `inspect`, `poses` and `convert --clean`."""
    commands = {
        "info": ("info", "s.ply", "--json", "--plot", "out.png", QUIET),
        "export": ("export", "s.ply", "-o", "out.html", QUIET),
        "inspect": ("inspect", "s", "-o", "out", QUIET),
        "poses": ("poses", "s", "s", "--json"),
        "convert --clean": ("convert", "s.ply", "out.ply", "--clean", QUIET),
        "render": ("render", "s", "-o", "out", "--size", "16x12", QUIET),
    }
    parts = [(part, *each) for part in LISTS for each in changed_json(sound.bytes(f"s/{part}"), f"{part} shown", 8)]
    parts += [("images/0.png", *each) for each in damaged(sound.bytes("s/images/0.png"), "shown", 3, 2, head=60)]
    memories = sound.bytes("s/memories.safetensors")
    parts += [("memories.safetensors", *each) for each in damaged(memories, "shown", 3, 2, head=3000)]
    for verb, command in commands.items():
        written = ("out", "out.ply", "out.png", "out.html")
        for part, what, content in parts:
            yield in_scene(sound, "damaged scenes, shown", f"{verb}, {part}: {what}", part, content, command, written)


def _exposures(sound: Sound) -> Iterator[Case]:
    """The colour transforms of a scene: read, and left out with --exposure off."""
    rows = [[1.0, 0.0, 0.0, 0.1], [0.0, 0.9, 0.0, 0.0], [0.0, 0.0, 1.1, -0.1]]
    whole = json.dumps({"photos": [{"name": "0.png", "matrix": rows}]}, indent=1).encode()
    matrices = {
        "all zeros": [[0.0] * 4] * 3,
        "nearly singular": [[1.0, 0, 0, 0], [0, 1e-9, 0, 0], [0, 0, 1, 0]],
        "huge": [[1e300] * 4, [-1e300] * 4, [1e300, 0, 0, 0]],
        "mirrored": [[-1.0, 0, 0, 1], [0, -1, 0, 1], [0, 0, -1, 1]],
        "two rows": rows[:2],
        "one axis more": [rows],
    }
    lies = [(what, json.dumps({"photos": [{"name": "0.png", "matrix": m}]}).encode()) for what, m in matrices.items()]
    twice = json.loads(whole)["photos"] * 2
    lies += [("sound", whole), ("twice", json.dumps({"photos": twice}).encode())]
    for what, content in (*lies, *changed_json(whole, "exposures", 20), *damaged(whole, "exposures", 10, 4)):
        for option in ((), ("--exposure", "off")):
            command = ("tto", "s", "--steps", "0", *option, QUIET)
            text = f"{what}{', --exposure off' if option else ''}"
            yield in_scene(sound, "exposures.json", text, "exposures.json", content, command)


def _points(sound: Sound) -> Iterator[Case]:
    """The points of structure from motion: read by `tto`, and written into a COLMAP model by `convert`."""
    commands = (("tto", "s", "--steps", "0", QUIET), ("convert", "s", "out", QUIET))
    points = sound.points()
    whole = points.read_bytes()
    lies = [("sound", whole), *changed_tensors(points, 40), *damaged(whole, "points", 12, 4, head=600)]
    for i, (what, content) in enumerate((*lies, *noise("points", 4))):
        command = commands[i % 2]
        yield in_scene(sound, "points.safetensors", f"{command[0]}, {what}", points.name, content, command)


def settings(sound: Sound) -> Iterator[Case]:
    lies = [
        ("a number of 5,000 digits", TOML.replace(b"seed = 0", b"seed = " + NINES.encode())),
        ("nested 5,000 times", b"a = " + b"[" * 5000),
        ("a base of itself", b'base = "in.toml"'),
        ("a base of a list", b"base = [1]"),
        ("lengths of NaN", TOML.replace(b"1e-3", b"nan")),
        ("negative steps", TOML.replace(b"steps = 12", b"steps = -2")),
        ("a date", TOML.replace(b"seed = 0", b"seed = 1979-05-27")),
        ("another type", TOML.replace(b"seed = 0", b'seed = "x"')),
        ("not UTF-8", TOML + b"\xff"),
    ]
    for what, content in (*lies, *damaged(TOML, "toml", 30, 8)):
        # A training that can be read is refused, because there is one in the folder already.
        made = several({"in.toml": content, "out/state.safetensors": b""})
        yield Case("TOML", what, made, ("train", "--config", "in.toml", "-o", "out", QUIET), REFUSED)
    made = several({"in.toml": TOML, "out/state.safetensors": b""})
    ways = list(places(tomllib.loads(TRAINING)))
    for i in range(80):
        rng = random.Random(f"settings {i}")
        change = f"{'.'.join(map(str, rng.choice(ways)))}={rng.choice(TOML_VALUES)}"
        command = ("train", "--config", "in.toml", "-o", "out", QUIET, "--set", change)
        yield Case("TOML", f"--set {change[:60]}", made, command, REFUSED)
    split = (
        b'{"dataset_path": "d", "total_samples": 1, "num_input_views": 2, "scale": "small", "samples": [{"scene_id": '
        b'"captured", "input_views": [{"path": "d/images/0.png", "frame_index": 0}, {"path": "d/images/4.png", '
        b'"frame_index": 4}], "interp_views": [{"path": "d/images/2.png", "frame_index": 2}], "extrap_views": []}]}'
    )
    evaluate = ("eval", str(sound.captured), "--splits", "in.json", "--splits-only", "-o", "out", QUIET)
    for what, content in changed_json(split, "split", 60):
        yield Case("split files", what, one_file("in.json", content), evaluate)
    for what, content in zips(sound.captured, 40):
        command = ("eval", "in.zip", "--views", "2", "--scales", "small", "--cases", "1", "--splits-only", "-o", "out")
        yield Case("zips", what, one_file("in.zip", content), (*command, QUIET))
