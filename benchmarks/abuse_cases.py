"""The hostile inputs of `abuse.py`, family by family."""

import json
import random
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

from abuse_inputs import (
    ANY,
    REFUSED,
    Case,
    Sound,
    changed_json,
    changed_tensors,
    damaged,
    exif,
    headers,
    noise,
    zips,
)

NINES = "9" * 5000
EXTREMES = ("-1", "0", "1e30", "nan", "inf", "-inf", NINES, "99999999999999999999", "", "x", "0x10", "１２")
LONG = "n" * 300 + ".ply"
QUIET = "-q"


def all_cases(sound: Sound, kills: int) -> Iterator[Case]:
    """Every case, in the order of the table. Each command is killed `kills` times by each signal."""
    yield from _gaussians(sound)
    yield from _cameras(sound)
    yield from _pictures(sound)
    yield from _scene_folder(sound)
    yield from _settings(sound)
    yield from _options(sound)
    yield from _places(sound)
    yield from _kills(sound, kills)


def _file(name: str, content: bytes) -> Callable[[Path], object]:
    def write(folder: Path) -> None:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)

    return write


def _gaussians(sound: Sound) -> Iterator[Case]:
    command = ("convert", "in.ply", "out.ply", QUIET)
    ply = sound.bytes("few.ply")
    for what, content in (*headers(ply), *damaged(ply, "ply", 60, 20, head=900), *noise("ply", 10)):
        yield Case("PLY", what, _file("in.ply", content), command)
    for kind in ("spz", "sog"):
        found = sound.bytes(f"few.{kind}")
        for what, content in (*damaged(found, kind, 60, 20, head=60), *noise(kind, 10)):
            yield Case(kind.upper(), what, _file(f"in.{kind}", content), ("convert", f"in.{kind}", "out.ply", QUIET))


def _cameras(sound: Sound) -> Iterator[Case]:
    listing = sound.bytes("transforms.json")
    for what, content in (*changed_json(listing, "transforms", 120), *damaged(listing, "transforms", 20, 10)):
        command = ("convert", "in.json", "out.json", QUIET)
        yield Case("transforms.json", what, _file("in.json", content), command)
    stored = sound.bytes("s/cameras.json")
    for what, content in changed_json(stored, "cameras", 60):
        yield _in_scene(sound, "cameras.json", what, "cameras.json", content, ("tto", "s", "--steps", "0", QUIET))
    for what, content in changed_json(stored, "frames", 30):
        command = ("render", "s.ply", "-o", "out", "--size", "16x12", QUIET)
        yield _in_scene(sound, "cameras.json, rendered", what, "cameras.json", content, command)
    for form, suffix in (("text", "txt"), ("binary", "bin")):
        for part in ("cameras", "images", "points3D"):
            whole = sound.bytes(f"{form}/{part}.{suffix}")
            for what, content in damaged(whole, f"{form} {part}", 25, 8):
                yield Case(
                    f"COLMAP, {form}",
                    f"{part}: {what}",
                    _model(sound, form, f"{part}.{suffix}", content),
                    ("convert", "model", "out.json", QUIET),
                )


def _model(sound: Sound, form: str, name: str, content: bytes) -> Callable[[Path], object]:
    def write(folder: Path) -> None:
        (folder / "model").mkdir()
        for file in (sound.folder / form).iterdir():
            (folder / "model" / file.name).write_bytes(content if file.name == name else file.read_bytes())

    return write


def _pictures(sound: Sound) -> Iterator[Case]:
    """A damaged picture beside its camera: `convert --photos` reads and straightens it."""
    import cv2

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


def _in_scene(
    sound: Sound, family: str, what: str, part: str, content: bytes | Callable[[Path], object], command: tuple[str, ...]
) -> Case:
    def write(folder: Path) -> None:
        sound.scene(folder)
        target = folder / "s" / part
        if callable(content):
            content(target)
        else:
            target.write_bytes(content)

    return Case(family, what, write, command)


def _scene_folder(sound: Sound) -> Iterator[Case]:
    again = ("tto", "s", "--steps", "1", QUIET)
    memories = sound.folder / "s" / "memories.safetensors"
    for what, change in changed_tensors(memories, 150):
        yield _in_scene(sound, "memories", what, memories.name, change, again)
    for what, content in damaged(memories.read_bytes(), "memories", 30, 10, head=3000):
        yield _in_scene(sound, "memories", what, memories.name, content, again)
    for part, count in (("report.json", 80), ("photos.json", 30)):
        for what, content in changed_json(sound.bytes(f"s/{part}"), part, count):
            yield _in_scene(sound, part, what, part, content, ("tto", "s", "--steps", "0", QUIET))
    yield from _exposures(sound)
    for what, content in damaged(sound.bytes("s/images/0.png"), "image", 10, 5, head=60):
        yield _in_scene(sound, "a scene's pictures", what, "images/0.png", content, again)


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
            yield _in_scene(sound, "exposures.json", text, "exposures.json", content, command)


TOML = b"""base = "compact"
seed = 3
[data]
samples = 4
[losses]
lpips = 0.0
[[stages]]
steps = 2
batch = 1
lr = 1e-3
"""


def _settings(sound: Sound) -> Iterator[Case]:
    lies = [
        ("a number of 5,000 digits", TOML.replace(b"seed = 3", b"seed = " + NINES.encode())),
        ("nested 5,000 times", b"a = " + b"[" * 5000),
        ("a base of itself", b'base = "in.toml"'),
        ("a base of a list", b"base = [1]"),
        ("lengths of NaN", TOML.replace(b"1e-3", b"nan")),
        ("negative steps", TOML.replace(b"steps = 2", b"steps = -2")),
        ("a date", TOML.replace(b"seed = 3", b"seed = 1979-05-27")),
        ("another type", TOML.replace(b"seed = 3", b'seed = "x"')),
        ("not UTF-8", TOML + b"\xff"),
    ]
    for what, content in (*lies, *damaged(TOML, "toml", 30, 8)):
        # There is nothing to resume, so that a training that can be read does not begin.
        made = _file("in.toml", content)
        yield Case(
            "TOML",
            what,
            made,
            ("train", "--config", "in.toml", "--resume", "-o", "nowhere", QUIET),
            REFUSED | {0},
            ("nowhere",),
        )
    split = (
        b'{"dataset_path": "d", "total_samples": 1, "num_input_views": 2, "scale": "small", "samples": [{"scene_id": '
        b'"captured", "input_views": [{"path": "d/images/0.png", "frame_index": 0}, {"path": "d/images/4.png", '
        b'"frame_index": 4}], "interp_views": [{"path": "d/images/2.png", "frame_index": 2}], "extrap_views": []}]}'
    )
    evaluate = ("eval", str(sound.captured), "--splits", "in.json", "--splits-only", "-o", "out", QUIET)
    for what, content in changed_json(split, "split", 60):
        yield Case("split files", what, _file("in.json", content), evaluate)
    for what, content in zips(sound.captured, 40):
        command = ("eval", "in.zip", "--views", "2", "--scales", "small", "--cases", "1", "--splits-only", "-o", "out")
        yield Case("zips", what, _file("in.zip", content), (*command, QUIET))


def _options(sound: Sound) -> Iterator[Case]:
    def scene(folder: Path) -> None:
        sound.scene(folder)

    numbers = {
        "reconstruct": ("--tto", "--queries", "--max-size", "--max-views", "--holdout-every", "--seed", "--budget"),
        "render": ("--frames", "--fps", "--size", "--background"),
        "convert": ("--scale", "--crop", "--up"),
        "tto": ("--steps", "--lr", "--densify", "--prune"),
        "inspect": ("--query",),
    }
    for verb, options in numbers.items():
        given = {
            "reconstruct": (str(sound.photos / "none.png"), "-o", "out.ply"),
            "convert": ("s.ply", "out.ply"),
            "render": ("s.ply", "-o", "out"),
            "tto": ("s",),
            "inspect": ("s", "-o", "out"),
        }[verb]
        for option in options:
            for value in EXTREMES:
                # Sound values run; render and tto are then small.
                extra = ("--size", "16x12") if verb == "render" and option != "--size" else ()
                extra += ("--steps", "0") if verb == "tto" and option != "--steps" else ()
                yield Case(
                    "options", f"{verb} {option} {value[:20]}", scene, (verb, *given, *extra, option, value, QUIET)
                )
    for name in (
        ".",
        "/",
        "..",
        "",
        "x",
        "x.glb",
        "x.sog",
        "x.compressed.ply",
        "a\0b.ply",
        "n" * 300 + ".ply",
        "s.ply/x.ply",
    ):
        photo = str(sound.photos / "0.png")
        command = ("reconstruct", photo, "-o", name, "--force", "--tto", "0", "--max-size", "96", QUIET)
        yield Case("options", f"output {name[:20]!r}", scene, command, REFUSED)
        yield Case("options", f"convert to {name[:20]!r}", scene, ("convert", "s.ply", name, "--force", QUIET), REFUSED)


def _places(sound: Sound) -> Iterator[Case]:
    def scene(folder: Path) -> None:
        sound.scene(folder)

    photo = str(sound.photos / "0.png")
    made = ("reconstruct", photo, "-o", "out.ply", "--tto", "0", "--max-size", "96")
    verbs = {
        "reconstruct": made,
        "tto": ("tto", "s", "--steps", "1"),
        "render": ("render", "s.ply", "-o", "out", "--size", "32x24"),
        "convert": ("convert", "s.ply", "out.spz"),
    }
    conditions = {
        "no HOME": {"env": {"HOME": None, "XDG_CACHE_HOME": None}},
        "HOME that is not there": {"env": {"HOME": "/nonexistent", "XDG_CACHE_HOME": None}},
        "TMPDIR that is not there": {"env": {"TMPDIR": "/nonexistent"}},
        "another user without a home": {"user": 65534},
        "one core": {"cores": 1},
        "files of at most 1 KB": {"limits": {"RLIMIT_FSIZE": 1000}},
        "files of at most 50 KB": {"limits": {"RLIMIT_FSIZE": 50_000}},
        "8 open files": {"limits": {"RLIMIT_NOFILE": 24}},
        "an address space of 1.2 GB": {"limits": {"RLIMIT_AS": 1_200_000_000}, "codes": frozenset({4})},
        "closed output": {"shell": "{} >&-", "codes": frozenset({0})},
        "closed messages": {"shell": "{} 2>&-", "codes": frozenset({0})},
        "everything closed": {"shell": "{} >&- 2>&- <&-", "codes": frozenset({0})},
        "a reader of one line": {"shell": "set -o pipefail; {} --json 2>&1 | head -1", "codes": frozenset({0})},
        "a reader that goes away": {"shell": "set -o pipefail; {} --json 2>&1 | true", "codes": frozenset({0})},
        "an ASCII terminal": {"env": {"PYTHONIOENCODING": "ascii", "LC_ALL": "C"}, "codes": frozenset({0})},
        "a folder that cannot be written": {"user": 65534, "mode": 0o555, "codes": REFUSED},
    }
    for verb, command in verbs.items():
        for what, place in conditions.items():
            if verb in ("reconstruct", "tto") and place.get("user") and "mode" not in place:
                continue  # without a cache, their kernels are compiled for minutes
            codes = place.get("codes", ANY)
            written = ("out", "out.ply", "out.spz", "s", "s.ply")
            yield Case("places", f"{verb}: {what}", scene, command, codes, written, "process", place)
    steps = {
        "tto .": ("cd s; {} tto . --steps 0 -q"),
        "tto s/../s": ("{} tto s/../s --steps 0 -q"),
        "inspect .": ("cd s; {} inspect . -q"),
        "reconstruct -o s/../s.ply --force": (
            f"{{}} reconstruct {photo} -o s/../s.ply --force --tto 0 --max-size 96 -q"
        ),
        "a folder that vanishes": ("mkdir v; cd v; rmdir ../v; {} convert ../s.ply out.ply -q"),
    }
    for what, shell in steps.items():
        codes = REFUSED if "vanishes" in what else frozenset({0})
        yield Case("places", what, scene, (), codes, ("s", "s.ply", "s-inspected"), "process", {"shell": shell})


KILL_SECONDS = {"reconstruct": 5.0, "tto": 6.0, "render": 4.0, "convert": 3.0, "inspect": 5.0, "demo": 6.0}
"""A command of each verb is killed after so many seconds of computing at most. Clocks would tell more on a busy machine
of how busy it is.
"""


def _kills(sound: Sound, count: int) -> Iterator[Case]:
    def scene(folder: Path) -> None:
        sound.scene(folder)

    photos = [str(sound.photos / f"{i}.png") for i in range(2)]
    small = ("--tto", "5", "--max-size", "160")
    commands = {
        "reconstruct": ("reconstruct", *photos, "-o", "out.ply", *small),
        "reconstruct over a scene": (
            "reconstruct",
            *photos,
            "-o",
            "s.ply",
            "--force",
            "--tto",
            "5",
            "--max-size",
            "160",
        ),
        "tto": ("tto", "s", "--steps", "30"),
        "render": ("render", "s.ply", "-o", "out", "--cameras", "orbit", "--size", "640x480"),
        "render over a folder": ("render", "s.ply", "-o", "out", "--force", "--size", "320x240"),
        "convert": ("convert", "s.ply", "out.spz"),
        "inspect": ("inspect", "s", "-o", "out"),
        "demo": ("demo", "-o", "out", "--photos", "3"),
    }
    for what, command in commands.items():
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGKILL):
            for i in range(count):
                rng = random.Random(f"{what} {number} {i}")
                # Python needs a moment until it can catch a signal.
                seconds = rng.uniform(0.8, KILL_SECONDS[command[0]])
                place = {"signal": int(number), "seconds": seconds}
                codes = frozenset({0, -9 if number == signal.SIGKILL else 128 + number})
                text = f"{what}: {signal.Signals(number).name} after {seconds:.2f} CPU s"
                yield Case(
                    "kills", text, scene, command, codes, ("out", "out.ply", "out.spz", "s", "s.ply"), "kill", place
                )
