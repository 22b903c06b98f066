"""Held-out quality and run time of `querysplat reconstruct` on the real sets, beside splatted depth.

    python benchmarks/reconstruct.py ../shared/data [--sets fortress kermit] [--json results.json] [--keep DIR]

Every 4th photo is held out. Each row is one run of the command in a process of its own, so that seconds
and memory are what a user sees; the splatted depth is measured on the same cameras by the same renderer.
"""

import argparse
import json
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

from querysplat_cli.reporting.report import machine

SETS = ("fortress", "dtu106", "sceaux", "kermit", "riverview", "fox")
FOX_VIEWS = 12


def photos_of(data: Path, name: str) -> list[Path]:
    if name != "fox":
        return [data / name / "images"]
    frames = sorted((data / "dl3dv" / "fox" / "images_4").iterdir())
    return [frames[round(i * (len(frames) - 1) / (FOX_VIEWS - 1))] for i in range(FOX_VIEWS)]


def reconstruct(photos: list[Path], folder: Path, cameras: str, options: list[str]) -> dict[str, Any]:
    command = ["querysplat", "reconstruct", *map(str, photos), "-o", str(folder / f"{cameras}.ply")]
    command += ["--holdout-every", "4", "--holdout-cameras", cameras, "--json", "--quiet", "--force", *options]
    start = time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        return {"error": done.stderr.strip().splitlines()[0], "code": done.returncode}
    return {**json.loads(done.stdout), "wall": time.perf_counter() - start}


def splatted_depth(photos: list[Path]) -> float:
    """Held-out PSNR of the encoder's depth, splatted as it is, with joint cameras."""
    from querysplat_cli.encoders.base import CameraRequest
    from querysplat_cli.encoders.holdout import estimate_holdout_cameras
    from querysplat_cli.encoders.registry import find_encoder
    from querysplat_cli.evaluation.baseline import back_project
    from querysplat_cli.reporting.view_scores import score
    from querysplat_cli.scene.photos import find_photos, load_photos

    def silent(text: str, fraction: float) -> None:
        pass

    encoder = find_encoder("classical")
    loaded, _ = load_photos(find_photos(photos), progress=silent)
    passes = estimate_holdout_cameras(
        loaded,
        4,
        "joint",
        lambda some: encoder.estimate_cameras(some, CameraRequest(448, 42), silent),
        poses_known=True,
    )
    posed, heldout = passes.chosen.inputs, passes.chosen.heldout
    geometry = encoder.estimate_geometry(posed, seed=42, progress=silent)
    return score(back_project(posed.views, posed.cameras, geometry.depth), *heldout).psnr if heldout else float("nan")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--sets", nargs="*", default=SETS)
    parser.add_argument("--json", type=Path, help="also write the results here")
    parser.add_argument("--keep", type=Path, help="keep the scenes in this folder")
    parser.add_argument("--options", default="", help="further options for `querysplat reconstruct`")
    arguments = parser.parse_args()
    rows = []
    print(f"{'set':<10} {'depth':>7} {'joint':>7} {'isolated':>9} {'s':>7} {'GiB':>5} {'Gaussians':>10}", flush=True)
    with tempfile.TemporaryDirectory() as scratch:
        for name in arguments.sets:
            folder = (arguments.keep or Path(scratch)) / name
            folder.mkdir(parents=True, exist_ok=True)
            photos = photos_of(arguments.data, name)
            run = reconstruct(photos, folder, "joint", arguments.options.split())
            if "error" in run:
                print(f"{name:<10} failed ({run['code']}): {run['error']}", flush=True)
                rows.append({"set": name, **run})
                continue
            heldout = run["quality"]["heldout"]
            row = {
                "set": name,
                "splatted_depth_psnr": splatted_depth(photos),
                "joint": heldout["joint"],
                "isolated": heldout["isolated"],
                "pose_difference": heldout["pose_difference"],
                "seconds": run["wall"],
                "stages": run["seconds"],
                "peak_memory_gib": run["peak_memory_gib"],
                "gaussians": run["gaussians"],
            }
            rows.append(row)
            isolated = row["isolated"]["psnr"] if row["isolated"] else float("nan")
            print(
                f"{name:<10} {row['splatted_depth_psnr']:7.2f} {row['joint']['psnr']:7.2f} {isolated:9.2f} "
                f"{row['seconds']:7.1f} {row['peak_memory_gib']:5.2f} {row['gaussians']:10,}",
                flush=True,
            )
    done = [row for row in rows if "error" not in row]
    if done:
        gain = sum(row["joint"]["psnr"] - row["splatted_depth_psnr"] for row in done) / len(done)
        print(f"mean gain over splatted depth, joint cameras: {gain:+.2f} dB over {len(done)} sets")
    if arguments.json:
        arguments.json.write_text(json.dumps({"machine": machine(), "rows": rows}, indent=2) + "\n")


if __name__ == "__main__":
    main()
