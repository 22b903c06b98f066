"""A scene is repaired: a region is taken out, its renders are restored as pictures, and these are lifted back.

    python benchmarks/repair.py scene.ply --box x0,y0,z0,x1,y1,z1 -o repair/
    python benchmarks/repair.py scene.ply --box … -o repair/ --restore 'mytool {picture} {mask} {restored}'

The box is in the units of the .ply. Pictures are taken from the scene's input cameras, or from those of --cameras. A
pixel belongs to the region where the render changes when the Gaussians in the box are left out. OpenCV's inpainting
restores by default; --restore runs a command for each picture instead. The last table has the PSNR of each stage
against renders of the whole scene, inside the region and outside. --figure shows the stages side by side, in the view
with the largest hole.
"""

import argparse
import math
import shlex
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from common.output import markdown, write_json
from querysplat_cli.cli import run
from querysplat_cli.commands.edits import inside_box
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.formats.ply import read_ply, write_ply
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.pictures import write_picture

import cv2
import numpy as np

CHANGED = 6 / 255
"""A pixel that changes by more than this when the region is left out belongs to it."""
BORDER = 3
"""Pixels by which masks are enlarged: splats fade out, and restoration continues from pixels that are whole."""
REACH = 5
"""Radius in pixels that OpenCV's inpainting looks at."""
SHOWN = ("whole", "damaged", "restored", "repaired-renders")
"""Folders of the stages' pictures, in the order of the figure from left to right."""
HOLES = "holes"
"""The folder of masks. Not "masks": `reconstruct` takes a folder of this name for masks of the photos beside it."""
FIGURE_QUALITY = 85
"""Quality in percent of the figure's JPEG."""

Restore = Callable[[Path, Path, Path], None]
"""Reads a picture and its mask (white: to be restored), and writes the restored picture."""


@dataclass(frozen=True)
class Stage:
    """PSNR in dB over all pictures, inside the region and outside of it."""

    name: str
    inside: float
    outside: float


def cut(gaussians: Gaussians, box: tuple[float, ...]) -> Gaussians:
    """The Gaussians whose centres are not in the box (x0, y0, z0, x1, y1, z1)."""
    inside = inside_box(box, gaussians.means)
    if not inside.any():
        raise QuerySplatError(f"no centre of a Gaussian is in the box {box}", "Give another box.")
    return gaussians[~inside]


def write_masks(whole: Path, damaged: Path, masks: Path) -> None:
    """White where a picture of `damaged` differs from that of `whole`, enlarged by `BORDER`."""
    masks.mkdir(parents=True, exist_ok=True)
    for file in sorted(whole.glob("*.png")):
        changed = np.abs(_read(file) - _read(damaged / file.name)).max(2) > CHANGED
        kernel = np.ones((2 * BORDER + 1,) * 2, np.uint8)
        cv2.imwrite(str(masks / file.name), cv2.dilate(changed.astype(np.uint8) * 255, kernel))


def inpaint(picture: Path, mask: Path, restored: Path) -> None:
    """OpenCV's inpainting (Telea 2004). It stands in for a learned restoration."""
    cv2.imwrite(
        str(restored), cv2.inpaint(cv2.imread(str(picture)), cv2.imread(str(mask), 0), REACH, cv2.INPAINT_TELEA)
    )


def command(template: str) -> Restore:
    """A command in which {picture}, {mask} and {restored} stand for files."""
    if "{restored}" not in template:
        raise QuerySplatError("--restore names no {restored}", "Say where the command writes its picture.")

    def restore(picture: Path, mask: Path, restored: Path) -> None:
        files = {"picture": picture, "mask": mask, "restored": restored}
        try:
            done = subprocess.run([part.format(**files) for part in shlex.split(template)], check=False)
        except (OSError, KeyError) as error:
            raise QuerySplatError(f"--restore {template!r} cannot be run: {error}", "Check the command.") from None
        if done.returncode or not restored.is_file():
            raise QuerySplatError(f"--restore: exit code {done.returncode}, no {restored}", "Check the command.")

    return restore


def restore_all(damaged: Path, masks: Path, restored: Path, restore: Restore) -> None:
    """Restored pictures under the same names, with the same cameras. What lies outside of a mask stays as it was."""
    restored.mkdir(parents=True, exist_ok=True)
    for mask in sorted(masks.glob("*.png")):
        restore(damaged / mask.name, mask, restored / mask.name)
        before, after = (cv2.imread(str(folder / mask.name)) for folder in (damaged, restored))
        if after is None or after.shape != before.shape:
            raise QuerySplatError(f"{restored / mask.name}: not a picture of the same size", "Check --restore.")
        inside = cv2.imread(str(mask), 0)[..., None] > 0
        cv2.imwrite(str(restored / mask.name), np.where(inside, after, before))
    shutil.copy(damaged / "cameras.json", restored / "cameras.json")


def score(name: str, folder: Path, whole: Path, masks: Path) -> Stage:
    """PSNR of the pictures of `folder` against those of `whole`. Every pixel of all pictures has the same weight."""
    sums = np.zeros((2, 2))
    for mask in sorted(masks.glob("*.png")):
        error = ((_read(folder / mask.name) - _read(whole / mask.name)) ** 2).mean(2)
        inside = cv2.imread(str(mask), 0) > 0
        sums += [[error[part].sum(), part.sum()] for part in (inside, ~inside)]
    inside, outside = (-10 * math.log10(max(total / max(count, 1), 1e-10)) for total, count in sums)
    return Stage(name, inside, outside)


def repair(
    scene: Path, box: tuple[float, ...], out: Path, restore: Restore, cameras: str = "inputs", options: str = ""
) -> list[Stage]:
    """All stages. `options` are further ones of `querysplat reconstruct`. Raises QuerySplatError where one fails."""
    out.mkdir(parents=True, exist_ok=True)
    whole, damaged, restored, renders = (out / stage for stage in SHOWN)
    masks = out / HOLES
    write_ply(out / "damaged.ply", cut(read_ply(scene), box))
    _querysplat("render", str(scene), "-o", str(whole), "--cameras", cameras)
    path = ("--cameras", str(whole / "cameras.json"))
    _querysplat("render", str(out / "damaged.ply"), "-o", str(damaged), *path)
    write_masks(whole, damaged, masks)
    restore_all(damaged, masks, restored, restore)
    poses = ("--poses", str(restored / "cameras.json"))
    _querysplat("reconstruct", str(restored), "-o", str(out / "repaired.ply"), *poses, *shlex.split(options))
    _querysplat("render", str(out / "repaired.ply"), "-o", str(renders), *path)
    stages = {"damaged": damaged, "restored pictures": restored, "repaired scene": renders}
    return [score(name, folder, whole, masks) for name, folder in stages.items()]


def write_figure(file: Path, out: Path) -> None:
    """The stages of `repair` in `out` side by side: the view of which the hole covers the most pixels."""
    view = max(sorted((out / HOLES).glob("*.png")), key=lambda mask: cv2.countNonZero(cv2.imread(str(mask), 0))).name
    strip = cv2.hconcat([cv2.imread(str(out / stage / view)) for stage in SHOWN])
    write_picture(file, strip[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, FIGURE_QUALITY])


def _querysplat(*arguments: str) -> None:
    code = run([*arguments, "--force", "--quiet"])
    if code:
        raise QuerySplatError(f"querysplat {shlex.join(arguments)} ended with code {code}", "See the message above.")


def _read(file: Path) -> np.ndarray:
    pixels = cv2.imread(str(file))
    if pixels is None:
        raise QuerySplatError(f"{file}: no picture that can be read", "Run the program again.")
    return pixels.astype(np.float64) / 255


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path, help="the scene's .ply")
    parser.add_argument("--box", required=True, help="x0,y0,z0,x1,y1,z1: what is taken out")
    parser.add_argument("-o", "--out", type=Path, default=Path("repair"))
    parser.add_argument(
        "--restore", help="a command with {picture}, {mask} and {restored}; default: OpenCV's inpainting"
    )
    parser.add_argument("--cameras", default="inputs", help="as for `querysplat render`")
    parser.add_argument("--options", default="", help="further options for `querysplat reconstruct`")
    parser.add_argument("--figure", type=Path, help="a JPEG: whole, damaged, restored, repaired in one view")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    box = tuple(float(part) for part in options.box.split(","))
    if len(box) != 6:
        parser.error("--box takes six numbers")
    restore = command(options.restore) if options.restore else inpaint
    try:
        stages = repair(options.scene, box, options.out, restore, options.cameras, options.options)
    except QuerySplatError as error:
        parser.error(f"{error.message} {error.hint}")
    if options.figure:
        write_figure(options.figure, options.out)
    rows = [(stage.name, f"{stage.inside:.2f}", f"{stage.outside:.2f}") for stage in stages]
    print(markdown(("stage", "PSNR in the region, dB", "PSNR outside, dB"), rows))
    write_json(options.json, scene=str(options.scene), box=box, stages=stages)


if __name__ == "__main__":
    main()
