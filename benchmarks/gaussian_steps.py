"""Held-out PSNR on grey against CPU seconds of optimisation in Gaussian space, of two revisions in one run.

    python benchmarks/gaussian_steps.py [DATA] [--against SOURCE] [--steps N] [--views V ...] [--passes DIR]

SOURCE is the `src` folder of another revision, e.g. of a git worktree. DATA is the folder of the photo sets, by default
$QUERYSPLAT_DATA. Every 4th photo is held out; cameras come from one pass over all photos (joint). Each run starts with
the scene that `reconstruct` has by default before its own steps in Gaussian space, and takes the same steps in either
revision, for each number of views a step. CPU seconds (user and system, all threads) are those of the steps; scores are
not counted. The revisions take turns, so that both meet the same machine. `--passes` names a folder that keeps the
scenes, too.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from querysplat_cli.reporting.view_scores import score
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.views import Views
from querysplat_cli.splat.conventions import MID_GREY
from querysplat_cli.tto.gaussians import optimise_gaussians
from querysplat_cli.tto.options import TtoSettings
from querysplat_cli.tto.rendering_loss import RenderingLoss

import torch

ROOT = Path(__file__).resolve().parents[1]
SETS = ("fortress", "dtu106", "kermit", "fox")
RATE = 0.005
SEED = 42
Group = tuple[Views, Cameras]


def keep_scene(path: Path, gaussians: Gaussians, inputs: Group, heldout: Group) -> None:
    """Write tensors alone, which every revision can read."""
    torch.save([vars(gaussians), *(vars(part) for group in (inputs, heldout) for part in group)], path)


def kept_scene(path: Path) -> tuple[Gaussians, Group, Group]:
    gaussians, *parts = torch.load(path)
    views, cameras, held_views, held_cameras = parts
    inputs, heldout = (Views(**views), Cameras(**cameras)), (Views(**held_views), Cameras(**held_cameras))
    return Gaussians(**gaussians), inputs, heldout


def run(path: Path, steps: int, views_per_step: int) -> dict[str, Any]:
    """CPU seconds of a run, and the held-out PSNR ahead of it and after it."""
    gaussians, inputs, heldout = kept_scene(path)
    target = RenderingLoss.for_solid_scenes(*inputs, torch.Generator().manual_seed(SEED))

    def optimised(count: int) -> Gaussians:
        settings = TtoSettings(count, RATE, views_per_step=views_per_step)
        generator = torch.Generator().manual_seed(SEED)
        return optimise_gaussians(gaussians, target, settings, generator=generator).gaussians

    optimised(2)  # compiles
    start = time.process_time()
    after = optimised(steps)
    seconds = time.process_time() - start
    before, now = (score(scene, *heldout, MID_GREY).psnr for scene in (gaussians, after))
    return {"seconds": seconds, "before": before, "after": now, "gaussians": len(gaussians)}


def in_revision(source: Path, path: Path, steps: int, views: int) -> dict[str, Any]:
    """`run` in a process of its own, with the package of `source`."""
    environment = {**os.environ, "PYTHONPATH": str(source)}
    command = [sys.executable, __file__, "--scene", str(path), "--steps", str(steps), "--views", str(views)]
    done = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    return dict(json.loads(done.stdout.splitlines()[-1]))


def compare(options: argparse.Namespace, folder: Path) -> list[dict[str, Any]]:
    # Imported here: a process for another revision has no use for them.
    from common.builds import build
    from common.output import Table
    from common.samples import SIZE, real_samples
    from querysplat_cli.model.checkpoints import load

    model = load("compact").requires_grad_(False)
    sources = {"this": ROOT / "src", **({"other": options.against} if options.against else {})}
    table = Table(
        {"set": "", "views": "", "steps": "", "revision": "", "CPU s": ".1f", "dB, start": ".2f", "dB": ".2f"}
    )
    rows = []
    for chosen, sample in real_samples(options.data, options.sets, SIZE, folder):
        path = folder / f"{chosen.name.replace('/', '-')}-scene.pt"
        if not path.is_file():
            scene = build(model, sample)
            heldout = (sample.targets, sample.target_cameras)
            keep_scene(path, scene.adapted.gaussians, (scene.posed.views, scene.adapted.cameras), heldout)
        for views in options.views:
            for steps in sorted({options.steps // 4, options.steps // 2, options.steps}):
                for name, source in sources.items():
                    found = in_revision(source, path, steps, views)
                    rows.append({"set": chosen.name, "views": views, "steps": steps, "revision": name, **found})
                    table.add(chosen.name, views, steps, name, found["seconds"], found["before"], found["after"])
    return rows


def main() -> None:
    if "--scene" in sys.argv:
        parser = argparse.ArgumentParser()
        parser.add_argument("--scene", type=Path)
        parser.add_argument("--steps", type=int)
        parser.add_argument("--views", type=int)
        one = parser.parse_args()
        print(json.dumps(run(one.scene, one.steps, one.views)))
        return
    from common.arguments import PhotoParser, folder_or_scratch
    from common.output import write_json

    options_parser = PhotoParser(__doc__)
    options_parser.add_argument("--against", type=Path, help="the `src` folder of another revision")
    options_parser.add_argument("--steps", type=int, default=120, help="of the longest run; also a half and a quarter")
    options_parser.add_argument("--views", type=int, nargs="+", default=[3, 1], help="views a step")
    options_parser.set_defaults(sets=SETS)
    options = options_parser.parse()
    with folder_or_scratch(options.passes) as folder:
        rows = compare(options, folder)
    write_json(options.json, rows=rows)


if __name__ == "__main__":
    main()
