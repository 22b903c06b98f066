"""One procedural street of N photos, reconstructed whole and in regions: held-out PSNR, seconds by stage, memory.

The photos have true cameras; --poses gives them to the program, without it the cameras are estimated. Every tenth photo
is held out.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from common.arguments import folder_or_scratch
from common.clock import children_cpu_seconds
from common.output import Table, write_json
from common.street_photos import take_street

STEP = 0.35
"""Metres from photo to photo."""


def measure(folder: Path, ply: Path, regions: int, more: list[str]) -> dict[str, Any]:
    """The row of one reconstruction."""
    command = [sys.executable, "-m", "querysplat_cli", "reconstruct", str(folder / "images"), "-o", str(ply)]
    command += ["--regions", str(regions), "--holdout-every", "10", "--json", "-q", "--force", *more]
    before = children_cpu_seconds()
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(done.stderr)
    report = json.loads(done.stdout)
    quality = report["quality"]
    return {
        "regions": regions,
        "cpu_seconds": children_cpu_seconds() - before,
        "seconds": report["seconds"],
        "gib": report["peak_memory_gib"],
        "gaussians": report["gaussians"],
        "input": quality["input"]["psnr"],
        "heldout": quality["heldout"]["psnr"] if quality["heldout"] else None,
        "report": report["regions"],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--photos", type=int, default=60)
    parser.add_argument("--size", type=int, default=224, help="longer side, in pixels")
    parser.add_argument("--regions", type=int, nargs="*", default=(1, 2, 4))
    parser.add_argument("--quality", default="draft")
    parser.add_argument("--poses", action="store_true", help="give the true cameras")
    parser.add_argument("--keep", type=Path, help="keep photos and scenes in this folder")
    parser.add_argument("--json", type=Path, help="also write the results here")
    options = parser.parse_args()
    table = Table(
        {"regions": "", "held out, dB": ".2f", "inputs, dB": ".2f", "CPU s": ".0f", "GiB": ".2f", "Gaussians": ","}
    )
    with folder_or_scratch(options.keep) as folder:
        if not (folder / "images").is_dir():
            take_street(folder / "images", options.photos, length=STEP * (options.photos - 1), width=options.size)
        more = ["--quality", options.quality, "--max-size", str(options.size), "--holdout-cameras", "joint"]
        if options.poses:
            more += ["--poses", str(folder / "transforms.json")]
        rows = []
        for count in options.regions:
            row = measure(folder, folder / f"street-{count}.ply", count, more)
            table.add(row["regions"], row["heldout"], row["input"], row["cpu_seconds"], row["gib"], row["gaussians"])
            rows.append(row)
            write_json(options.json, rows=rows)


if __name__ == "__main__":
    main()
