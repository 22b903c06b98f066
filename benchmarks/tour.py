"""Run every verb on the demo's room, and write the commands with their real output to docs/tour.md.

    python benchmarks/tour.py [--write docs/tour.md] [--pictures docs/images] [--keep DIR] [--only VERB ...]

Everything happens in DIR, by default a temporary folder. --only runs some of the verbs alone: the page then keeps the
other sections as they are.
"""

import argparse
import re
import shlex
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from common.arguments import folder_or_scratch
from querysplat_cli.reporting.report import machine

import cv2

WIDTH = 960
"""Pixels of the pictures on the page."""
QUALITY = 85
"""Of their JPEG, in per cent."""
MOST_LINES = 36
"""Of what a command prints."""
REPOSITORY = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Stop:
    """A verb: its commands, and a picture that one of them makes (from the working folder), with a caption."""

    verb: str
    text: str
    commands: tuple[str, ...]
    picture: str = ""
    caption: str = ""


STOPS = (
    Stop("doctor", "What this machine can do.", ("doctor",)),
    Stop(
        "demo",
        "Twelve photos of a made-up room, and their scene. The pictures alone reach the reconstruction.",
        ("demo -o room",),
        "room/scene/preview.png",
        "`room/scene/preview.png`: photos on the left, the scene from the same places on the right.",
    ),
    Stop(
        "reconstruct",
        "The same photos again, three of which are held out and score the scene.",
        ("reconstruct room/photos -o held.ply --holdout-every 4 --quality draft",),
    ),
    Stop("tto", "A stored scene goes on.", ("tto held --steps 20",)),
    Stop(
        "render",
        "Pictures along a path, with depth, or a film.",
        ("render room/scene.ply -o frames --cameras orbit --frames 4 --depth", "render room/scene.ply -o film.mp4"),
        "frames",
        "The four frames, from places where no photo was taken.",
    ),
    Stop(
        "inspect",
        "What the scene consists of.",
        ("inspect room/scene -o inspected",),
        "inspected/attention_geometry.png",
        "`attention_geometry.png`: where on each photo one query attends to.",
    ),
    Stop(
        "convert",
        "A smaller file, a clean one, a mesh, and the cameras and points as a COLMAP model.",
        (
            "convert room/scene.ply room.spz",
            "convert room/scene.ply clean.ply --clean",
            "convert room/scene.ply mesh.glb --mesh",
            "convert room/scene model --text",
        ),
    ),
    Stop("info", "What is odd about a scene.", ("info room/scene.ply",)),
    Stop(
        "view",
        "The scene in the browser, until Ctrl-C ([what is on the page](viewing.md)).",
        ("view room/scene.ply --no-browser",),
    ),
    Stop("export", "One page to send to others.", ("export room/scene.ply",)),
    Stop("poses", "Cameras that were estimated with and without the held-out photos.", ("poses held room/scene",)),
    Stop(
        "eval",
        "The paper's protocol on one case. Other scenes than the demo's have more frames and more cases.",
        ("eval room/scene --views 2 --scales small --cases 1 --tto 0 --cameras posed -o evaluation",),
    ),
    Stop("train", "What a training would take, measured with one sample.", ("train --config small --dry-run",)),
    Stop("weights", "Files that are not part of the package.", ("weights",)),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", type=Path, default=Path("docs/tour.md"))
    parser.add_argument("--pictures", type=Path, default=Path("docs/images"))
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--only", nargs="+", choices=[stop.verb for stop in STOPS], metavar="VERB")
    arguments = parser.parse_args()
    before = sections(arguments.write)
    with folder_or_scratch(arguments.keep) as folder:
        for stop in STOPS:
            if arguments.only is None or stop.verb in arguments.only:
                before[stop.verb] = section(stop, folder, arguments)
                arguments.write.write_text(page(before))


def page(found: dict[str, str]) -> str:
    """The whole page, of the verbs that were run so far."""
    head = (
        "# A tour of the verbs\n\nMade by\n\n    python benchmarks/tour.py --write docs/tour.md\n\n"
        f"on {machine()}. Times are those of one run; other programs beside make them longer ([how much](speed.md)). "
        "Each section is one verb with its real output, on the room of `querysplat demo`; lines of progress are left "
        "out.\n[The command line](cli.md) has every option.\n"
    )
    return "\n".join([head, *(f"## {stop.verb}\n\n{found[stop.verb]}" for stop in STOPS if stop.verb in found)])


def sections(path: Path) -> dict[str, str]:
    """The sections of an earlier page by their verbs."""
    parts = re.split(r"^## (\w+)\n\n", path.read_text(), flags=re.MULTILINE) if path.is_file() else []
    return {verb: f"{text.rstrip()}\n" for verb, text in zip(parts[1::2], parts[2::2], strict=True)}


def section(stop: Stop, folder: Path, arguments: argparse.Namespace) -> str:
    """The text of one verb, after running its commands."""
    blocks = [f"$ querysplat {command}\n{output(command, folder)}" for command in stop.commands]
    text = f"{stop.text}\n\n```\n{''.join(blocks)}```\n"
    if stop.picture:
        name = f"tour_{stop.verb}.jpg"
        shrink(folder / stop.picture, arguments.pictures / name)
        text += f"\n![{stop.verb}](images/{name})\n\n{stop.caption}\n"
    return text


def output(command: str, folder: Path) -> str:
    """What the command prints, without its progress. Exits where it fails."""
    words = [sys.executable, "-m", "querysplat_cli", *shlex.split(command)]
    with subprocess.Popen(words, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as running:
        assert running.stdout
        lines = []
        for line in running.stdout:
            lines.append(line.rstrip())
            if command.startswith("view"):  # serves until Ctrl-C
                running.send_signal(signal.SIGINT)
    if running.returncode:
        sys.exit("\n".join([f"querysplat {command}", *lines]))
    lines = [line for line in lines if not is_progress(line)]
    said = "".join(f"{line}\n" for line in (*lines[:MOST_LINES], *(["…"] if lines[MOST_LINES:] else [])))
    return said.replace(str(folder), "…").replace(str(REPOSITORY), "…")


def is_progress(line: str) -> bool:
    """A stage that begins is one or two words alone in a line; what it says later is indented."""
    return bool(re.fullmatch(r"[a-z]+( [a-z]+){0,2}|  [a-z ]+: .*\d s.*", line))


def shrink(source: Path, target: Path) -> None:
    """A picture of at most WIDTH pixels; of a folder, its colour pictures beside each other."""
    if source.is_dir():
        files = sorted(file for file in source.glob("*.png") if "depth" not in file.name)
        picture = cv2.hconcat([cv2.imread(str(file)) for file in files])
    else:
        picture = cv2.imread(str(source))
    scale = min(1.0, WIDTH / picture.shape[1])
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(target), small, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])


if __name__ == "__main__":
    main()
