"""What more photos cost and bring: `querysplat reconstruct` as it is, with 1 to 48 photos of fox.

    python benchmarks/views.py [DATA] [--views 1 2 3 4 6 8 12 24 48] --json benchmarks/results/views.json

DATA is the folder of the photo sets, by default $QUERYSPLAT_DATA; fox is tuned on. Each scene is one run of the command
in a process of its own, with no option but the photos. Two photos near the middle are never inputs. Their cameras are
those of the data set, moved to the scene by the similarity of the inputs' cameras; *fitted* refines them on the
finished scene, and so leaves errors of the cameras out. One photo fixes no similarity, and has no score. Numbers of
photos that the JSON file has are not measured again without --again.
"""

import sys
from pathlib import Path
from statistics import fmean
from typing import Any

from common.arguments import PhotoParser, folder_or_scratch
from common.command import reconstructed
from common.output import Table, read_rows, write_rows
from common.photo_sets import PHOTO_SETS
from querysplat_cli.evaluation.cameras import to_frame_of
from querysplat_cli.evaluation.fitted import fitted_photo_camera
from querysplat_cli.evaluation.metrics import Meter
from querysplat_cli.evaluation.protocol import photograph
from querysplat_cli.scene.cameras import rescaled
from querysplat_cli.scene.formats.known import read_known_cameras
from querysplat_cli.scene.formats.ply import read_ply
from querysplat_cli.scene.photos import WHOLE, load_photo
from querysplat_cli.scene.views import Photo

import torch

VIEWS = (1, 2, 3, 4, 6, 8, 12, 24, 48)
HELD = (23, 26)
"""Places of the two photos that are never inputs."""
FARTHEST = 6
"""Neighbouring inputs are at most this many photos apart, so that two of them still overlap."""


def chosen(count: int, of: int) -> list[int]:
    """Places of `count` inputs among `of` photos: evenly spaced around the middle, beside the held-out ones."""
    free = [place for place in range(of) if place not in HELD]
    step = min(FARTHEST, (of - 1) / max(1, count - 1))
    picked: list[int] = []
    for number in range(count):
        wanted = sum(HELD) / 2 + step * (number - (count - 1) / 2)
        picked.append(min((place for place in free if place not in picked), key=lambda place: abs(place - wanted)))
    return sorted(picked)


def measure(photos: list[Path], places: list[int], known: Path, folder: Path) -> dict[str, Any]:
    """The row of one scene."""
    ply = folder / f"fox-{len(places)}.ply"
    row: dict[str, Any] = {"views": len(places), "photos": [photos[place].name for place in places]}
    report = reconstructed([photos[place] for place in places], ply)
    if "error" in report:
        return row | {"error": report["error"]}
    row |= {"seconds": report["wall"], "cpu_seconds": report["cpu_seconds"]}
    row |= {"stages": report["seconds"], "gib": report["peak_memory_gib"], "gaussians": report["gaussians"]}
    row |= {"placed": len(report["views"]["used"]), "input_psnr": report["quality"]["input"]["psnr"]}
    return row | heldout(ply, [photos[place] for place in HELD], known)


def heldout(ply: Path, held: list[Path], known: Path) -> dict[str, float | None]:
    """Mean PSNR of the held-out photos: plain, colour-corrected, and from fitted cameras."""
    inputs = read_known_cameras(ply.with_suffix(""))
    if len(inputs) < 2:
        return dict.fromkeys(("psnr", "psnr_cc", "psnr_fitted"))
    cameras, gaussians, meter = to_frame_of(inputs, read_known_cameras(known)), read_ply(ply), Meter()
    rows = []
    for file in held:
        photo = load_photo(file, file.name, WHOLE)
        assert isinstance(photo, Photo)
        camera = rescaled(cameras[file.name], photo.height, photo.width)
        truth = torch.from_numpy(photo.pixels).permute(2, 0, 1).float() / 255
        fitted = fitted_photo_camera(gaussians, camera, photo, max(photo.height, photo.width))
        scores = meter.compare(photograph(gaussians, camera), truth)
        rows.append((scores.psnr, scores.psnr_cc, meter.plain(photograph(gaussians, fitted), truth)[0]))
    return dict(zip(("psnr", "psnr_cc", "psnr_fitted"), map(fmean, zip(*rows, strict=True)), strict=True))


def main() -> None:
    parser = PhotoParser(__doc__, sets=False, passes=False)
    parser.add_argument("--views", type=int, nargs="*", default=VIEWS, choices=range(1, 49), metavar="N")
    parser.add_argument("--again", action="store_true", help="measure again what the JSON file has")
    parser.add_argument("--keep", type=Path, help="keep the scenes in this folder")
    options = parser.parse()
    photos = PHOTO_SETS["fox"].files(options.data)
    rows = {row["views"]: row for row in read_rows(options.json)}
    scores = dict.fromkeys(("held out, dB", "cc, dB", "fitted, dB"), ".2f")
    table = Table({"photos": "", "placed": "", **scores, "s": ".0f", "CPU s": ".0f", "GiB": ".2f", "Gaussians": ","})
    with folder_or_scratch(options.keep) as folder:
        for count in options.views:
            if options.again or count not in rows or "error" in rows[count]:
                known = photos[0].parents[1] / "transforms.json"
                rows[count] = measure(photos, chosen(count, len(photos)), known, folder)
                write_rows(options.json, [rows[views] for views in sorted(rows)])
            show(table, rows[count])


def show(table: Table, row: dict[str, Any]) -> None:
    if "error" in row:
        print(f"{row['views']} photos: {row['error']}", file=sys.stderr)
        return
    keys = "psnr", "psnr_cc", "psnr_fitted", "seconds", "cpu_seconds", "gib", "gaussians"
    table.add(row["views"], row["placed"], *(row[key] for key in keys))


if __name__ == "__main__":
    main()
