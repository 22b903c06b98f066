"""Held-out quality of checkpoints on the real sets, before and after test-time optimisation, beside splatted depth.

    python benchmarks/feedforward.py ../shared/data --models compact initial.safetensors --tto 0 50 [--json FILE]

Every 4th photo is held out, cameras are those of one pass over all photos (joint), as in benchmarks/reconstruct.py. The
encoder works once for each set, and every model and number of steps sees what it found; `--passes DIR` keeps that.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import torch

from querysplat_cli.encoders.base import Located
from querysplat_cli.encoders.registry import find_encoder
from querysplat_cli.evaluation.baseline import back_project
from querysplat_cli.holdout import locate_passes
from querysplat_cli.model.checkpoints import load
from querysplat_cli.quality import score
from querysplat_cli.remembering import remember
from querysplat_cli.report import machine
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.photos import find_photos, load_photos
from querysplat_cli.training.passes import Sample, read_sample, write_sample
from querysplat_cli.tto.features import optimise_memories
from querysplat_cli.tto.optimise import TtoSettings
from querysplat_cli.tto.plan import LEARNING_RATE, VIEWS_PER_STEP
from querysplat_cli.tto.rendering_loss import RenderingLoss
from reconstruct import SETS, photos_of

SEED = 42


def silent(text: str, fraction: float) -> None:
    pass


def passed(data: Path, name: str) -> Sample:
    """What the encoder finds of the inputs, and the held-out views."""
    encoder = find_encoder("classical")
    photos, _ = load_photos(find_photos(photos_of(data, name)))
    chosen = locate_passes(
        photos,
        4,
        "joint",
        lambda some: encoder.locate(some, max_size=encoder.size, seed=SEED, known=None, progress=silent),
        poses_known=True,
    ).chosen
    assert chosen.heldout
    inputs = chosen.inputs
    geometry = encoder.perceive(inputs, seed=SEED, progress=silent)
    return Sample(inputs.views, inputs.cameras, geometry, *chosen.heldout)


def kept(data: Path, name: str, folder: Path | None) -> Sample:
    if folder is None:
        return passed(data, name)
    path = folder / f"{name}.safetensors"
    if not path.is_file():
        write_sample(path, passed(data, name))
    return read_sample(path)


def rows(name: str, sample: Sample, models: list[str], steps: list[int]) -> list[dict[str, Any]]:
    assert sample.geometry.depth is not None
    depth = back_project(sample.views, sample.cameras, sample.geometry.depth)
    found = [{"set": name, "row": "depth", "steps": 0, **scores(depth, sample)}]
    located = Located(sample.views, sample.cameras, torch.zeros(0, 3), ())
    for given in models:
        model = load(given)
        remembered = remember(model, located, sample.geometry, queries=None, target="kv")
        for count in steps:
            result = optimise_memories(
                model,
                remembered.variables,
                remembered.anchors,
                RenderingLoss(sample.views, sample.cameras),
                TtoSettings(count, LEARNING_RATE, VIEWS_PER_STEP),
                generator=torch.Generator().manual_seed(SEED),
            )
            found.append({"set": name, "row": given, "steps": count, **scores(result.gaussians, sample)})
    return found


def scores(gaussians: Gaussians, sample: Sample) -> dict[str, float]:
    return score(gaussians, sample.targets, sample.target_cameras).summary()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--models", nargs="+", default=["compact"], help="presets or checkpoint files")
    parser.add_argument("--tto", nargs="+", type=int, default=[0, 50], help="steps of test-time optimisation")
    parser.add_argument("--sets", nargs="*", default=SETS)
    parser.add_argument("--passes", type=Path, help="a folder for what the encoder finds")
    parser.add_argument("--json", type=Path, help="also write the results here")
    arguments = parser.parse_args()
    found: list[dict[str, Any]] = []
    for name in arguments.sets:
        for row in rows(name, kept(arguments.data, name, arguments.passes), arguments.models, arguments.tto):
            found.append(row)
            print(f"{name:<10} {row['row']:<40} {row['steps']:>3} {row['psnr']:6.2f} {row['ssim']:.3f}", flush=True)
    for row, steps in dict.fromkeys((row["row"], row["steps"]) for row in found):
        these = [each for each in found if (each["row"], each["steps"]) == (row, steps)]
        psnr, ssim = (sum(each[key] for each in these) / len(these) for key in ("psnr", "ssim"))
        print(f"{'mean':<10} {row:<40} {steps:>3} {psnr:6.2f} {ssim:.3f}")
    if arguments.json:
        arguments.json.write_text(json.dumps({"machine": machine(), "rows": found}, indent=2) + "\n")


if __name__ == "__main__":
    main()
