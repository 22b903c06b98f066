"""Good and bad photos of the demo's room: what each kind makes, for docs/capture.md and docs/images/capture.jpg.

    python benchmarks/capture_examples.py [--write docs/capture.md] [--picture docs/images/capture.jpg] [--keep DIR]

Each kind is photos of one room. Every scene is one `querysplat reconstruct --quality draft --tto 20 --max-size
224` in a process of its own, and is shown from a place between the photos, beside the room itself.
"""

import argparse
import json
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from common.arguments import folder_or_scratch
from querysplat_cli.pipeline.gaussian_files import read_gaussians
from querysplat_cli.reporting.report import machine
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.formats.transforms import read_cameras
from querysplat_cli.scene.paths import on_the_line
from querysplat_cli.scene.pictures import eight_bit, write_picture
from querysplat_cli.splat.render import render
from querysplat_cli.training.photographer import cast, walk
from querysplat_cli.training.rooms import make_room

import cv2
import numpy as np
import torch

SEED, COUNT = 42, 7
SMALL = ("--quality", "draft", "--tto", "20", "--max-size", "224")
HEIGHT = 150
"""Pixels of a picture in a row."""
Pictures = list[np.ndarray]


@dataclass(frozen=True)
class Kind:
    """Photos of one kind: their cameras from those of a walk, and what is done to the pictures."""

    name: str
    lesson: str
    cameras: Callable[[Cameras], Cameras] = lambda path: path
    spoil: Callable[[Pictures], Pictures] = lambda pictures: pictures


def turning(path: Cameras) -> Cameras:
    """All photos from the place of the middle one."""
    centre = path.centres[COUNT // 2]
    w2c = path.w2c.clone()
    w2c[:, :3, 3] = -(w2c[:, :3, :3] @ centre)
    return replace(path, w2c=w2c)


def shaken(pictures: Pictures) -> Pictures:
    """Moved by a thirtieth of the width while the shutter was open."""
    length = pictures[0].shape[1] // 30
    return [cv2.filter2D(picture, -1, np.full((1, length), 1 / length)) for picture in pictures]


def flickering(pictures: Pictures) -> Pictures:
    """Automatic exposure and white balance: every photo in another light."""
    light = np.random.default_rng(SEED).uniform(0.6, 1.3, (len(pictures), 3))
    return [np.clip(p * gains, 0, 255).astype(np.uint8) for p, gains in zip(pictures, light, strict=True)]


KINDS = (
    Kind("steps to the side", "what to do"),
    Kind("three photos only", "more photos: what one photo shows alone has no depth", lambda path: path[[0, 3, 6]]),
    Kind(
        "turned on the spot",
        "steps to the side: without them the scene is right from this one place alone",
        turning,
    ),
    Kind("shaken", "hold still, or more light: blur has no match and no detail", spoil=shaken),
    Kind("changing light", "keep exposure and white balance; `--exposure auto` mends most of it", spoil=flickering),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", type=Path, default=Path("docs/capture.md"))
    parser.add_argument("--picture", type=Path, default=Path("docs/images/capture.jpg"))
    parser.add_argument("--keep", type=Path)
    arguments = parser.parse_args()
    room = make_room(SEED)
    path = walk(room, COUNT, SEED)
    strips, lines = [], []
    with folder_or_scratch(arguments.keep) as folder:
        for kind in KINDS:
            place = folder / kind.name.replace(" ", "-")
            report = reconstructed(kind, room, path, place)
            strips.append(strip(room, kind.cameras(path), place))
            lines.append(row(kind, report))
    cv2.imwrite(str(arguments.picture), cv2.vconcat(strips)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 85])
    head = (
        f"Measured on {machine()}, other work beside.\n\n| photos | what the run said | lesson |\n| --- | --- | --- |\n"
    )
    table = f"<!-- table of benchmarks/capture_examples.py -->\n{head}{''.join(lines)}<!-- end -->"
    text = re.sub(r"<!-- table.*?<!-- end -->", lambda _: table, arguments.write.read_text(), flags=re.DOTALL)
    arguments.write.write_text(text)


def reconstructed(kind: Kind, room: object, path: Cameras, place: Path) -> dict[str, object] | str:
    """The report of the photos' scene, or the message where there is none. A scene that is there is kept."""
    if not (place / "scene" / "report.json").is_file():
        cameras = kind.cameras(path)
        pictures = kind.spoil([eight_bit(cast(room, cameras[[i]])[0][0]) for i in range(len(cameras))])
        for i, picture in enumerate(pictures):
            write_picture(place / "photos" / f"{i}.png", picture)
        options = ["-o", str(place / "scene.ply"), *SMALL, "--force", "--quiet"]
        command = [sys.executable, "-m", "querysplat_cli", "reconstruct", str(place / "photos"), *options]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            return done.stderr.splitlines()[0].removeprefix("error: ")
    report: dict[str, object] = json.loads((place / "scene" / "report.json").read_text())
    return report


def row(kind: Kind, report: dict[str, object] | str) -> str:
    if isinstance(report, str):
        return f"| {kind.name} | error: {report} | {kind.lesson} |\n"
    views, quality, warnings = report["views"], report["quality"], report["warnings"]
    said = [f"{len(views['used'])} photos used, {quality['input']['psnr']:.1f} dB on them"]  # type: ignore[index, call-overload]
    said += [f"warning: {warning}" for warning in warnings]  # type: ignore[attr-defined]
    return f"| {kind.name} | {'; '.join(said)} | {kind.lesson} |\n"


def strip(room: object, path: Cameras, place: Path) -> np.ndarray:
    """Two photos, the room from between them, and the scene from there: [HEIGHT, width, 3]."""
    files = sorted((place / "photos").glob("*.png"))
    photos = [cv2.imread(str(files[i]))[..., ::-1] for i in (0, len(files) // 2)]
    if not (place / "scene.ply").is_file():
        return joined([*photos, *[np.full_like(photos[0], 255)] * 2])
    cameras = read_cameras(place / "scene" / "cameras.json")[0].cameras
    between = on_the_line(cameras[[0, len(cameras) // 2]], 0.5)
    shown = render(read_gaussians(place / "scene.ply"), between, background=torch.full((3,), 0.5)).colour[0]
    true = eight_bit(cast(room, on_the_line(path[[0, len(path) // 2]], 0.5))[0][0])
    return joined([*photos, true, eight_bit(shown.clamp(0, 1))])


def joined(pictures: Pictures) -> np.ndarray:
    width = HEIGHT * 4 // 3
    return cv2.hconcat([cv2.resize(np.ascontiguousarray(p), (width, HEIGHT), interpolation=3) for p in pictures])


if __name__ == "__main__":
    main()
