"""Scenes of each `--quality`, held-out, at the working size and at full screen, over black and over mid-grey.

    python benchmarks/fullscreen.py [DATA] [--sets NAME ...] [--qualities draft standard high] [--json FILE]
                                    [--pictures DIR] [--keep DIR]

DATA is the folder of the photo sets, by default $QUERYSPLAT_DATA. Each scene is one `querysplat reconstruct
--holdout-every 4 --holdout-cameras joint` in a process of its own. Photos at full screen have at most 1,600 pixels on
the longer side. *cc*: each channel mapped to the photo's, as gsplat's trainer scores. --pictures writes, for each set,
a held-out photo and its renders over mid-grey beside each other, at full screen.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from common.arguments import PhotoParser, folder_or_scratch
from common.command import reconstructed
from common.output import Table, write_json
from common.photo_sets import PHOTO_SETS, PhotoSet, Use
from common.samples import HOLDOUT_EVERY
from querysplat_cli.pipeline.full_size import files_of
from querysplat_cli.pipeline.read_scene import read_scene, read_scene_gaussians
from querysplat_cli.pipeline.scene_folder import StoredScene
from querysplat_cli.reporting.view_scores import score
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.photo_files import large_views
from querysplat_cli.scene.pictures import eight_bit, write_picture
from querysplat_cli.scene.views import Views
from querysplat_cli.splat.conventions import MID_GREY
from querysplat_cli.splat.render import render

import numpy as np
import torch

FULL_SCREEN = 1600
"""The longer side of a picture at full screen, in pixels."""
QUALITIES = ("draft", "standard", "high", "max")
Held = tuple[Views, Cameras]


@dataclass(frozen=True)
class Scores:
    """Of held-out views: PSNR (dB) over black and grey and colour-corrected over grey, and SSIM over grey."""

    size: int
    black: float
    grey: float
    corrected: float
    ssim: float
    ssim_corrected: float


@dataclass(frozen=True)
class Row:
    """One scene. `cpu_seconds` are of both cores together; `stages` are seconds by the clock."""

    set: str
    use: Use
    quality: str
    working: Scores
    full: Scores
    seconds: float
    cpu_seconds: float
    stages: dict[str, float]
    gib: float
    gaussians: int


def measure(
    photo_set: PhotoSet,
    quality: str,
    data: Path,
    folder: Path,
    pictures: Path | None,
    asked: Sequence[str] | None = None,
) -> Row | None:
    """The row of one scene; None where the command fails, whose message is printed.

    `asked` are the options of the scene, by default `--quality`; the row then has `quality` for a name.
    """
    ply = scene_file(photo_set, quality, folder)
    options = ["--quality", quality] if asked is None else asked
    held = ["--holdout-every", str(HOLDOUT_EVERY), "--holdout-cameras", "joint"]
    report = reconstructed(photo_set.photos(data), ply, *options, *held)
    if "error" in report:
        print(f"{photo_set.name}: {report['error']}", file=sys.stderr)
        return None
    scene, _ = read_scene(ply)
    assert scene.heldout
    gaussians, screen = read_scene_gaussians(ply, scene), at_full_screen(scene)
    if pictures:
        beside(pictures / f"{ply.stem}.jpg", gaussians, screen)
    return Row(
        photo_set.name,
        photo_set.use,
        quality,
        scored(gaussians, scene.heldout),
        scored(gaussians, screen),
        report["wall"],
        report["cpu_seconds"],
        report["seconds"],
        report["peak_memory_gib"],
        report["gaussians"],
    )


def scene_file(photo_set: PhotoSet, quality: str, folder: Path) -> Path:
    """Where `measure` writes the scene of a set."""
    return folder / f"{photo_set.name.replace('/', '-')}-{quality.replace(' ', '_')}.ply"


def at_full_screen(scene: StoredScene) -> Held:
    """The held-out photos of a scene that has some, at `FULL_SCREEN` or their own size, and their cameras."""
    assert scene.heldout
    return large_views(files_of(scene, scene.heldout[0]), *scene.heldout, FULL_SCREEN)


def scored(gaussians: Gaussians, held: Held) -> Scores:
    """Scores of the held-out views at their own size."""
    black, grey = (score(gaussians, *held, level) for level in (0.0, MID_GREY))
    size = max(max(shape) for shape in held[0].sizes)
    return Scores(size, black.psnr, grey.psnr, grey.psnr_cc, grey.ssim, grey.ssim_cc)


def beside(path: Path, gaussians: Gaussians, held: Held) -> None:
    """Write the middle one of the held-out photos and its render over mid-grey, beside each other."""
    views, cameras = held
    middle = len(views) // 2
    height, width = views.sizes[middle]
    with torch.no_grad():
        drawn = render(gaussians, cameras[[middle]]).over(torch.full((3,), MID_GREY))[0].clamp(0, 1)
    pair = [eight_bit(picture[:, :height, :width]) for picture in (views.picture(middle), drawn)]
    path.parent.mkdir(parents=True, exist_ok=True)
    write_picture(path, np.concatenate(pair, 1))


def show(table: Table, row: Row) -> None:
    working, full = row.working, row.full
    quality = working.black, working.grey, full.grey, full.corrected, full.ssim, full.ssim_corrected
    costs = row.seconds, row.cpu_seconds, row.gib, row.gaussians
    table.add(row.set, row.use, row.quality, *quality[:2], full.size, *quality[2:], *costs)


def main() -> None:
    parser = PhotoParser(__doc__, passes=False)
    parser.add_argument("--qualities", nargs="*", choices=QUALITIES, default=QUALITIES[:3])
    parser.add_argument("--pictures", type=Path, help="write photos beside renders into this folder")
    parser.add_argument("--keep", type=Path, help="keep the scenes in this folder")
    parser.set_defaults(sets=tuple(PHOTO_SETS))
    options = parser.parse()
    scores = {"black, dB": ".2f", "grey, dB": ".2f", "full screen, px": "", "grey there, dB": ".2f", "cc, dB": ".2f"}
    scores |= {"SSIM": ".3f", "SSIM cc": ".3f"}
    table = Table(
        {"set": "", "use": "", "quality": "", **scores, "s": ".0f", "CPU s": ".0f", "GiB": ".2f", "Gaussians": ","}
    )
    rows = []
    with folder_or_scratch(options.keep) as folder:
        for photo_set in (PHOTO_SETS[name] for name in options.sets):
            for quality in options.qualities:
                row = measure(photo_set, quality, options.data, folder, options.pictures)
                if row:
                    rows.append(row)
                    show(table, row)
    write_json(options.json, rows=rows)


if __name__ == "__main__":
    main()
