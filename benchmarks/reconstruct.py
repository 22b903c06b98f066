"""Held-out quality and run time of `querysplat reconstruct` on the real sets, beside splatted depth.

    python benchmarks/reconstruct.py [DATA] [--sets fortress kermit] [--json results.json] [--keep DIR]

DATA is the folder of the photo sets, by default $QUERYSPLAT_DATA. Every 4th photo is held out. Each row is one run of
the command with joint cameras in a process of its own, so that seconds and memory are what a user sees. Another run has
isolated cameras, for its score alone. The splatted depth is scored on the joint cameras and with the same renderer.
Scores are over black, but for "on grey" and "on white", which must agree with them: where they are lower, one can see
through the scene.
"""

import sys
from pathlib import Path
from typing import Any

from common.arguments import PhotoParser, folder_or_scratch
from common.command import reconstructed
from common.output import Table, write_json
from common.photo_sets import PHOTO_SETS, PhotoSet
from common.samples import HOLDOUT_EVERY, joint_sample
from querysplat_cli.evaluation.baseline import back_project
from querysplat_cli.pipeline.read_scene import read_scene, read_scene_gaussians
from querysplat_cli.reporting.view_scores import score
from querysplat_cli.runtime.choices import HoldoutProtocol

CAMERAS: tuple[HoldoutProtocol, HoldoutProtocol] = ("joint", "isolated")


def splatted_depth(photos: list[Path]) -> float:
    """Held-out PSNR of the encoder's depth, splatted as it is, with joint cameras."""
    sample = joint_sample(photos)
    assert sample.geometry.depth is not None
    depth = back_project(sample.views, sample.cameras, sample.geometry.depth)
    return score(depth, sample.targets, sample.target_cameras).psnr


def on_white(scene: Path) -> float:
    """Held-out PSNR of a written scene over white."""
    stored, _ = read_scene(scene)
    assert stored.heldout
    return score(read_scene_gaussians(scene, stored), *stored.heldout, 1.0).psnr


def measure(photo_set: PhotoSet, data: Path, folder: Path, options: list[str]) -> dict[str, Any]:
    """The row of one set; `error` and `code` where the command fails."""
    folder.mkdir(parents=True, exist_ok=True)
    photos = photo_set.photos(data)
    labels = {"set": photo_set.name, "use": photo_set.use}
    run, alone = (
        reconstructed(
            photos,
            folder / f"{cameras}.ply",
            "--holdout-every",
            str(HOLDOUT_EVERY),
            "--holdout-cameras",
            cameras,
            *options,
        )
        for cameras in CAMERAS
    )
    failed = next((one for one in (run, alone) if "error" in one), None)
    if failed:
        return {**labels, **failed}
    isolated = alone["quality"]["heldout"]
    return {
        **labels,
        "splatted_depth_psnr": splatted_depth(photos),
        "joint": run["quality"]["heldout"],
        "joint_psnr_white": on_white(folder / "joint.ply"),
        "isolated": isolated,
        "pose_difference": isolated and isolated["pose_difference"],
        "seconds": run["wall"],
        "cpu_seconds": run["cpu_seconds"],
        "stages": run["seconds"],
        "peak_memory_gib": run["peak_memory_gib"],
        "gaussians": run["gaussians"],
    }


def show(table: Table, row: dict[str, Any]) -> None:
    if "error" in row:
        print(f"{row['set']} failed ({row['code']}): {row['error']}", file=sys.stderr)
        return
    isolated = row["isolated"] and row["isolated"]["psnr"]
    joint = row["joint"]["psnr"], row["joint"]["psnr_grey"], row["joint_psnr_white"]
    costs = row["seconds"], row["cpu_seconds"], row["peak_memory_gib"], row["gaussians"]
    table.add(row["set"], row["use"], row["splatted_depth_psnr"], *joint, isolated, *costs)


def main() -> None:
    parser = PhotoParser(__doc__, passes=False)
    parser.add_argument("--keep", type=Path, help="keep the scenes in this folder")
    parser.add_argument("--options", default="", help="further options for `querysplat reconstruct`")
    options = parser.parse()
    rows = []
    scores = dict.fromkeys(("depth, dB", "joint, dB", "on grey, dB", "on white, dB", "isolated, dB"), ".2f")
    table = Table({"set": "", "use": "", **scores, "s": ".0f", "CPU s": ".0f", "GiB": ".2f", "Gaussians": ","})
    with folder_or_scratch(options.keep) as folder:
        for photo_set in (PHOTO_SETS[name] for name in options.sets):
            rows.append(measure(photo_set, options.data, folder / photo_set.name, options.options.split()))
            show(table, rows[-1])
    done = [row for row in rows if "error" not in row]
    for use in dict.fromkeys(row["use"] for row in done):
        gains = [row["joint"]["psnr"] - row["splatted_depth_psnr"] for row in done if row["use"] == use]
        mean = sum(gains) / len(gains)
        print(f"mean gain over splatted depth, joint cameras: {mean:+.2f} dB over {len(gains)} sets ({use})")
    write_json(options.json, rows=rows)


if __name__ == "__main__":
    main()
