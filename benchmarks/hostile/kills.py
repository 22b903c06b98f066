"""Commands that a signal ends at a random instant: each verb, fresh and over what is there."""

import random
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from subprocess import DEVNULL

from hostile.attempt import PROGRAM
from hostile.case import Case, several
from hostile.sound import TRAINING, Sound

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGKILL)
TIMES = 5
"""How often each signal ends a command. The demo takes minutes, and is ended less often."""
OF_TERMINALS = (signal.SIGINT, signal.SIGHUP)
"""Signals that a terminal sends to a command and its workers together; half of the times they are sent so."""
WRITTEN = ("out", "out.ply", "out.spz", "out.lod", "out.html", "out.png", "out.mp4", "passes", "s", "s.ply")


@dataclass(frozen=True)
class Killed:
    """A command. `over` writes what it finds there, into the folder of the case. A `server` waits until it is ended.

    Each signal ends it so many `times`.
    """

    command: tuple[str, ...]
    over: Callable[[Sound, Path], object] = lambda sound, folder: None
    server: bool = False
    times: int = TIMES


def kills(sound: Sound) -> Iterator[Case]:
    """Each command, ended by each signal at shares of its length that are drawn; half of them are in its second half.

    `attempt_kill` makes instants of them.
    """
    for i in range(TIMES):
        for what, killed in _commands(sound).items():
            for number in SIGNALS if i < killed.times else ():
                share = random.Random(f"{what} {number} {i}").uniform(0.0 if i % 2 else 0.5, 1.0)
                codes = frozenset({0, -9 if number == signal.SIGKILL else 128 + number})
                text = f"{what}: {number.name} at {share:.1%}"
                place = {"signal": int(number), "share": share, "situation": what, "server": killed.server}
                place["group"] = i % 2 == 1 and number in OF_TERMINALS
                yield Case("kills", text, _writer(sound, killed), killed.command, codes, WRITTEN, "kill", place)


def _writer(sound: Sound, killed: Killed) -> Callable[[Path], object]:
    def write(folder: Path) -> None:
        sound.scene(folder)
        killed.over(sound, folder)

    return write


def _commands(sound: Sound) -> dict[str, Killed]:
    photo = str(sound.photos / "0.png")
    small = ("--tto", "3", "--max-size", "96", "--quality", "draft")
    split = ("--splits", str(sound.room / "split.json"), "--cameras", "posed", "--tto", "2", "--max-size", "96")
    evaluate = ("eval", str(sound.room), *split, "--pictures", "images", "-o", "out")
    train = ("train", "--config", "training.toml", "-o", "out", "--workers", "1")
    cameras = str(sound.room / "transforms.json")
    posed = (str(sound.room / "images"), "--poses", cameras, "-o", "s.ply", "--force")
    film = ("render", "s.ply", "-o", "out.mp4", "--size", "160x120", "--frames", "24")
    levels = ("convert", "s.ply", "out.lod", "--levels", "1")
    info = ("info", "s.ply", "--plot", "out.png")
    demo = ("demo", "-o", "out", "--photos", "3")
    return {
        "reconstruct": Killed(("reconstruct", photo, "-o", "out.ply", *small)),
        "reconstruct over a scene": Killed(("reconstruct", *posed, *small)),
        "tto": Killed(("tto", "s", "--steps", "10")),
        "demo": Killed(demo, times=2),
        "demo over a demo": Killed((*demo, "--force"), _demo, times=1),
        "view": Killed(("view", "s.ply", "--no-browser"), server=True),
        "export": Killed(("export", "s.ply", "-o", "out.html")),
        "export over a file": Killed(("export", "s.ply", "-o", "out.html", "--force"), _html),
        "render": Killed(("render", "s.ply", "-o", "out", "--cameras", "orbit", "--size", "320x240")),
        "render over a folder": Killed(("render", "s.ply", "-o", "out", "--force"), _frames),
        "render a film": Killed(film),
        "convert": Killed(("convert", "s.ply", "out.spz")),
        "convert over a file": Killed(("convert", "s.ply", "out.spz", "--force"), _spz),
        "convert to levels": Killed(levels),
        "convert over levels": Killed((*levels, "--force"), _levels),
        "info": Killed(info),
        "info over a picture": Killed((*info, "--force"), _picture),
        "inspect": Killed(("inspect", "s", "-o", "out")),
        "inspect over a folder": Killed(("inspect", "s", "-o", "out", "--force"), _drawings),
        "eval": Killed(evaluate),
        "eval, again": Killed(evaluate, _evaluated),
        "poses": Killed(("poses", cameras, cameras, "--plot", "out.png")),
        "poses --colmap": Killed(("poses", str(sound.room), "--colmap")),
        "train": Killed(train, _training),
        "train --resume": Killed((*train, "--resume"), _trained),
        "weights": Killed(("weights", "--verify")),
        "doctor": Killed(("doctor",)),
    }


def _frames(sound: Sound, folder: Path) -> None:
    """What `render --force` may replace as a whole."""
    several({"out/0.png": sound.bytes("photos/0.png"), "out/cameras.json": b"{}"})(folder)


def _drawings(sound: Sound, folder: Path) -> None:
    """What `inspect --force` may replace as a whole."""
    several({f"out/{name}.png": sound.bytes("photos/0.png") for name in ("attention_geometry", "query")})(folder)


def _spz(sound: Sound, folder: Path) -> None:
    (folder / "out.spz").write_bytes(sound.bytes("few.spz"))


def _levels(sound: Sound, folder: Path) -> None:
    shutil.copytree(sound.folder / "few.lod", folder / "out.lod")


def _picture(sound: Sound, folder: Path) -> None:
    (folder / "out.png").write_bytes(sound.bytes("photos/0.png"))


def _html(sound: Sound, folder: Path) -> None:
    (folder / "out.html").write_text("<html></html>")


def _demo(sound: Sound, folder: Path) -> None:
    _begun(sound, folder, _commands(sound)["demo"].command, "out/scene.ply")


def _evaluated(sound: Sound, folder: Path) -> None:
    _begun(sound, folder, _commands(sound)["eval"].command, "out/posed_tto=2/split/room_000/metrics.json")


def _training(sound: Sound, folder: Path) -> None:
    (folder / "training.toml").write_text(TRAINING)


def _trained(sound: Sound, folder: Path) -> None:
    _begun(sound, folder, _commands(sound)["train"].command, "out/state.safetensors")


def _begun(sound: Sound, folder: Path, command: tuple[str, ...], file: str) -> None:
    """What `command` has written when `file` appears, and it is stopped. It runs once for all cases."""
    kept = sound.folder / f"{command[0]} begun"
    if not kept.exists():
        kept.mkdir()
        _training(sound, kept)
        with subprocess.Popen([*PROGRAM, *command], cwd=kept, stdout=DEVNULL, stderr=DEVNULL) as process:
            while not (kept / file).exists() and process.poll() is None:
                time.sleep(0.01)
            process.terminate()
    shutil.copytree(kept, folder, dirs_exist_ok=True)
