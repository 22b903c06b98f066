"""What correcting the cameras during optimisation brings on the real sets, with good cameras and with wrong ones.

    python benchmarks/refine_cameras.py [DATA] [--sets fortress] [--turned 0 1] [--steps 50] [--json FILE]

DATA is the folder of the photo sets, by default $QUERYSPLAT_DATA. Every 4th photo is held out. Structure from motion
over all photos finds the cameras. Those of the inputs are then turned at random about each axis, by as many pixels
(standard deviation) as --turned says. Depth is found with these cameras. The scene is optimised twice: its cameras are
kept, or refined. A similarity brings the cameras of the held-out views to the frame of the inputs' cameras, so that
their score shows the quality of the scene and not where it lies.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from common.arguments import PhotoParser
from common.builds import UNLIMITED, settings
from common.output import Table, write_json
from common.photo_sets import PHOTO_SETS, PhotoSet, Use
from common.samples import SEED, joint_pass
from querysplat_cli.encoders.base import Geometry, PosedViews
from querysplat_cli.encoders.holdout import PosedSplit
from querysplat_cli.encoders.registry import find_encoder
from querysplat_cli.model.checkpoints import load
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.pipeline.build import build_scene
from querysplat_cli.pipeline.settings import ReconstructSettings
from querysplat_cli.reporting.view_scores import score
from querysplat_cli.runtime.progress import silent
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.sim3 import align_cameras
from querysplat_cli.tto.cameras import with_refined_focal

import torch


@dataclass(frozen=True)
class Row:
    """One scene; `turned` in pixels, PSNR in dB of the inputs and of the held-out views, seconds of optimisation."""

    set: str
    use: Use
    turned: float
    refined: bool
    input: float
    heldout: float
    seconds: float


def turned(cameras: Cameras, pixels: float) -> Cameras:
    """The cameras after random rotations."""
    random = torch.Generator().manual_seed(SEED)
    turns = torch.randn(3, len(cameras), generator=random).double() * pixels / cameras.K[:, 0, 0].double()
    return cameras.to(torch.float64).perturbed(turns.T, torch.zeros_like(turns.T)).to(cameras.w2c.dtype)


def scores(
    model: QuerySplat, true: PosedSplit, posed: PosedViews, geometry: Geometry, options: ReconstructSettings
) -> tuple[float, float, float]:
    """PSNR of the inputs and of the held-out views of the scene from the cameras of `posed`; its seconds."""
    assert true.heldout
    views, theirs = true.heldout
    adapted = build_scene(posed, geometry, model, options).adapted
    similarity = align_cameras(true.inputs.cameras.w2c, adapted.cameras.w2c)
    cameras = with_refined_focal(theirs.transformed(similarity), posed.cameras, adapted.cameras)
    inputs = score(adapted.gaussians, posed.views, adapted.cameras).psnr
    heldout = score(adapted.gaussians, views, cameras).psnr
    return inputs, heldout, adapted.runs[0][1].history[-1].seconds


def rows(photo_set: PhotoSet, data: Path, amounts: list[float], steps: int) -> Iterator[tuple[Row, Row]]:
    """For each amount in pixels, the scene with cameras kept and the one with cameras refined."""
    model, encoder = load("compact").requires_grad_(False), find_encoder("classical")
    true = joint_pass(photo_set.photos(data), encoder, encoder.size)
    for pixels in amounts:
        posed = replace(true.inputs, cameras=turned(true.inputs.cameras, pixels))
        geometry = encoder.estimate_geometry(posed, seed=SEED, progress=silent)
        pair = []
        for refine in (False, True):
            options = settings(tto=steps, prune="off", refine_cameras=refine, queries=UNLIMITED)
            found = scores(model, true, posed, geometry, options)
            pair.append(Row(photo_set.name, photo_set.use, pixels, refine, *found))
        yield pair[0], pair[1]


def main() -> None:
    parser = PhotoParser(__doc__, passes=False)
    parser.add_argument("--turned", nargs="+", type=float, default=[0.0, 1.0], help="pixels")
    parser.add_argument("--steps", type=int, default=50)
    options = parser.parse()
    found: list[Row] = []
    columns = ("held out, kept", "held out, refined", "inputs, kept", "inputs, refined")
    table = Table({"set": "", "use": "", "cameras turned by, px": "g", **dict.fromkeys(columns, ".2f")})
    for photo_set in (PHOTO_SETS[name] for name in options.sets):
        for kept, refined in rows(photo_set, options.data, options.turned, options.steps):
            found += [kept, refined]
            cells = kept.heldout, refined.heldout, kept.input, refined.input
            table.add(photo_set.name, photo_set.use, kept.turned, *cells)
    write_json(options.json, rows=found)


if __name__ == "__main__":
    main()
