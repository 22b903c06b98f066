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
TIMES = 6
"""How often each signal ends each command."""
FIRST = 0.8
"""CPU seconds before which no command is ended: Python needs a moment until it can catch a signal."""
WRITTEN = ("out", "out.ply", "out.spz", "out.html", "out.png", "passes", "s", "s.ply")


@dataclass(frozen=True)
class Killed:
    """A command, and the CPU seconds in which it is ended. Clocks would tell how busy the machine is.

    Most commands take so many seconds on the machine of docs/reliability.md. The demo takes longer.

    `over` writes what the command finds there, into the folder of the case.
    """

    command: tuple[str, ...]
    seconds: float
    over: Callable[[Sound, Path], object] = lambda sound, folder: None


def kills(sound: Sound) -> Iterator[Case]:
    """Each command, ended by each signal at instants that are drawn; half of them are in its second half."""
    for i in range(TIMES):
        for what, killed in _commands(sound).items():
            for number in SIGNALS:
                earliest = FIRST if i % 2 else killed.seconds / 2
                seconds = random.Random(f"{what} {number} {i}").uniform(earliest, killed.seconds)
                codes = frozenset({0, -9 if number == signal.SIGKILL else 128 + number})
                text = f"{what}: {number.name} after {seconds:.2f} CPU s"
                place = {"signal": int(number), "seconds": seconds}
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
    return {
        "reconstruct": Killed(("reconstruct", photo, "-o", "out.ply", *small), 5.4),
        "reconstruct over a scene": Killed(("reconstruct", *posed, *small), 6.0),
        "tto": Killed(("tto", "s", "--steps", "10"), 5.6),
        "render": Killed(("render", "s.ply", "-o", "out", "--cameras", "orbit", "--size", "320x240"), 3.8),
        "render over a folder": Killed(("render", "s.ply", "-o", "out", "--force"), 3.1, _pictures),
        "convert": Killed(("convert", "s.ply", "out.spz"), 3.4),
        "convert over a file": Killed(("convert", "s.ply", "out.spz", "--force"), 3.4, _spz),
        "inspect": Killed(("inspect", "s", "-o", "out"), 5.8),
        "inspect over a folder": Killed(("inspect", "s", "-o", "out", "--force"), 5.8, _pictures),
        "info": Killed(("info", "s.ply", "--plot", "out.png"), 3.3),
        "view": Killed(("view", "s.ply", "--no-browser"), 2.0),
        "export": Killed(("export", "s.ply", "-o", "out.html"), 2.9),
        "export over a file": Killed(("export", "s.ply", "-o", "out.html", "--force"), 2.6, _html),
        "poses": Killed(("poses", cameras, cameras, "--plot", "out.png"), 2.8),
        "poses --colmap": Killed(("poses", str(sound.room), "--colmap"), 3.6),
        "eval": Killed(evaluate, 7.0),
        "eval, again": Killed(evaluate, 5.0, _evaluated),
        "train": Killed(train, 7.0, _training),
        "train --resume": Killed((*train, "--resume"), 6.1, _trained),
        "weights": Killed(("weights", "--verify"), 2.0),
        "demo": Killed(("demo", "-o", "out", "--photos", "3"), 7.0),
    }


def _pictures(sound: Sound, folder: Path) -> None:
    """What `--force` may replace as a whole: a folder of pictures."""
    for name in ("0.png", "attention_geometry.png"):
        several({f"out/{name}": sound.bytes("photos/0.png")})(folder)


def _spz(sound: Sound, folder: Path) -> None:
    (folder / "out.spz").write_bytes(sound.bytes("few.spz"))


def _html(sound: Sound, folder: Path) -> None:
    (folder / "out.html").write_text("<html></html>")


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
