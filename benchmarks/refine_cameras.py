"""What correcting the cameras during optimisation brings, with good cameras and with wrong ones, on the real sets.

    python benchmarks/refine_cameras.py ../shared/data [--sets fortress] [--turned 0 1] [--steps 50] [--json FILE]

Every 4th photo is held out. Cameras come from structure from motion over all photos; those of the inputs are then
turned at random by as many pixels about each axis (standard deviation), depth is found with these, and the scene is
optimised with its cameras kept and refined. Held-out views are rendered with their own cameras, brought to the frame of
the inputs' by a similarity, so that their score says what the scene is worth and not where it ended up.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from feedforward import SEED, silent
from querysplat_cli.encoders.base import CameraRequest, PosedViews
from querysplat_cli.encoders.holdout import estimate_holdout_cameras
from querysplat_cli.encoders.registry import find_encoder
from querysplat_cli.model.checkpoints import load
from querysplat_cli.queries.prepare import prepare
from querysplat_cli.reporting.report import machine
from querysplat_cli.reporting.view_scores import score
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.photos import find_photos, load_photos
from querysplat_cli.scene.rotations import skew
from querysplat_cli.scene.sim3 import align_cameras
from querysplat_cli.tto.cameras import with_refined_focal
from querysplat_cli.tto.features import optimise_memories
from querysplat_cli.tto.optimise import TtoSettings
from querysplat_cli.tto.plan import LEARNING_RATE, VIEWS_PER_STEP
from querysplat_cli.tto.rendering_loss import RenderingLoss
from reconstruct import SETS, photos_of


def turned(cameras: Cameras, pixels: float) -> Cameras:
    random = torch.Generator().manual_seed(SEED)
    turns = torch.randn(3, len(cameras), generator=random).double() * pixels / cameras.K[:, 0, 0].double()
    w2c = cameras.w2c.double()
    w2c[:, :3] = torch.linalg.matrix_exp(skew(turns.T)) @ w2c[:, :3]
    return replace(cameras, w2c=w2c.to(cameras.w2c.dtype))


def rows(data: Path, name: str, amounts: list[float], steps: int) -> list[dict[str, Any]]:
    encoder = find_encoder("classical")
    photos, _ = load_photos(find_photos(photos_of(data, name)))

    def estimate_cameras(some: Any) -> PosedViews:
        return encoder.estimate_cameras(some, CameraRequest(encoder.size, SEED), silent)

    passes = estimate_holdout_cameras(photos, 4, "joint", estimate_cameras, poses_known=True).chosen
    assert passes.heldout
    views, theirs = passes.heldout
    model, found = load("compact"), []
    for pixels in amounts:
        posed = replace(passes.inputs, cameras=turned(passes.inputs.cameras, pixels))
        geometry = encoder.estimate_geometry(posed, seed=SEED, progress=silent)
        prepared = prepare(model, posed, geometry, queries=None, target="kv")
        for refine in (False, True):
            result = optimise_memories(
                model,
                prepared.variables,
                prepared.anchors,
                RenderingLoss(posed.views, posed.cameras),
                TtoSettings(steps, LEARNING_RATE, VIEWS_PER_STEP),
                generator=torch.Generator().manual_seed(SEED),
                refine_cameras=refine,
            )
            similarity = align_cameras(passes.inputs.cameras.w2c, result.cameras.w2c)
            cameras = with_refined_focal(theirs.transformed(similarity), posed.cameras, result.cameras)
            inputs = score(result.gaussians, posed.views, result.cameras).psnr
            heldout = score(result.gaussians, views, cameras).psnr
            seconds = result.history[-1].seconds
            row = {"set": name, "turned": pixels, "refined": refine}
            found.append({**row, "input": inputs, "heldout": heldout, "seconds": seconds})
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--sets", nargs="*", default=SETS)
    parser.add_argument("--turned", nargs="+", type=float, default=[0.0, 1.0], help="pixels")
    parser.add_argument("--steps", type=int, default=50)
    parser.add_argument("--json", type=Path, help="also write the results here")
    arguments = parser.parse_args()
    found = []
    print("| set | cameras turned by, px | held out, kept | held out, refined | inputs, kept | inputs, refined |")
    print("| --- | --- | --- | --- | --- | --- |")
    for name in arguments.sets:
        here = rows(arguments.data, name, arguments.turned, arguments.steps)
        found += here
        for kept, refined in zip(here[::2], here[1::2], strict=True):
            cells = (kept["heldout"], refined["heldout"], kept["input"], refined["input"])
            print(f"| {name} | {kept['turned']:g} | {' | '.join(f'{cell:.2f}' for cell in cells)} |", flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps({"machine": machine(), "rows": found}, indent=2) + "\n")


if __name__ == "__main__":
    main()
