"""One procedural street of N photos, reconstructed whole and in regions: held-out PSNR, seconds by stage, memory.

The photos have true cameras; --poses gives them to the program, without it the cameras are estimated. Every tenth photo
is held out. --places makes scenes of 30 photos of it as well, and compares them with the first large one on the same
held-out photos.
"""

import argparse
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from common.arguments import folder_or_scratch
from common.command import reconstructed
from common.output import Table, write_json
from common.street_photos import take_street

STEP = 0.35
"""Metres from photo to photo."""
PLACE = 30
"""Photos of a place."""


def measure(images: Path, ply: Path, more: list[str]) -> dict[str, Any]:
    """The row of one reconstruction; `heldout` and `inputs` are the PSNR of photos by name."""
    report = reconstructed([images], ply, "--holdout-every", "10", *more)
    if "error" in report:
        raise SystemExit(report["error"])
    quality = report["quality"]
    return {
        "photos": len(list(images.iterdir())),
        "regions": max(1, len(report["regions"])),
        "cpu_seconds": report["cpu_seconds"],
        "wall_seconds": report["wall"],
        "seconds": report["seconds"],
        "gib": report["peak_memory_gib"],
        "gaussians": report["gaussians"],
        **{name: _by_name(quality[name]) for name in ("input", "heldout")},
        "report": report["regions"],
        "seams": report["seams"],
    }


def _by_name(quality: dict[str, Any] | None) -> dict[str, float]:
    return {name: row["psnr"] for name, row in quality["views"].items()} if quality else {}


def _mean(scores: dict[str, float], names: Iterable[str] = ()) -> float | None:
    """Of the photos with these names, or of all."""
    found = [scores[name] for name in names or scores if name in scores]
    return sum(found) / len(found) if found else None


def photos_of(folder: Path, first: int) -> Path:
    """A folder with the photos of one place, from photo `first` on."""
    place = folder / f"place-{first}"
    place.mkdir(exist_ok=True)
    for photo in sorted((folder / "images").iterdir())[first : first + PLACE]:
        shutil.copy(photo, place)
    return place


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--photos", type=int, default=60)
    parser.add_argument("--size", type=int, default=224, help="longer side, in pixels")
    parser.add_argument("--regions", nargs="*", default=["1", "2", "4"], help="numbers, or auto")
    parser.add_argument("--places", type=int, nargs="*", default=(), help="first photos, multiples of 10")
    parser.add_argument("--quality", default="draft")
    parser.add_argument("--poses", action="store_true", help="give the true cameras")
    parser.add_argument("--keep", type=Path, help="keep photos and scenes in this folder")
    parser.add_argument("--json", type=Path, help="also write the results here")
    options = parser.parse_args()
    table = Table({
        "photos": "", "regions": "", "held out, dB": ".2f", "inputs, dB": ".2f", "same photos, dB": ".2f",
        "CPU s": ".0f", "CPU s a photo": ".2f", "s": ".0f", "GiB": ".2f", "Gaussians": ",",
    })  # fmt: skip
    with folder_or_scratch(options.keep) as folder:
        take_street(folder / "images", options.photos, length=STEP * (options.photos - 1), width=options.size)
        more = ["--quality", options.quality, "--holdout-cameras", "joint"]
        if options.poses:
            more += ["--poses", str(folder / "transforms.json")]
        runs = [(folder / "images", f"street-{count}", ["--regions", count]) for count in options.regions]
        runs += [(photos_of(folder, first), f"scene-{first}", []) for first in options.places]
        rows: list[dict[str, Any]] = []
        for images, name, regions in runs:
            row = measure(images, folder / f"{name}.ply", [*more, *regions])
            rows.append(row)
            row["same"] = _mean(rows[0]["heldout"], row["heldout"]) if row["photos"] < rows[0]["photos"] else None
            each = row["cpu_seconds"] / row["photos"]
            table.add(
                row["photos"], row["regions"], _mean(row["heldout"]), _mean(row["input"]), row["same"],
                row["cpu_seconds"], each, row["wall_seconds"], row["gib"], row["gaussians"],
            )  # fmt: skip
            write_json(options.json, rows=rows)


if __name__ == "__main__":
    main()
