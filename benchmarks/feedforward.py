"""Held-out quality of checkpoints on the real sets, before and after test-time optimisation, beside splatted depth.

    python benchmarks/feedforward.py ../shared/data --models compact initial.safetensors --tto 0 50 [--json FILE]

Every 4th photo is held out, cameras are those of one pass over all photos (joint), as in benchmarks/reconstruct.py. The
encoder works once for each set, and every model and number of steps sees what it found; `--passes DIR` keeps that.
`--made-up N` adds N procedural scenes, made as those of the training `--config` but with a seed that no training uses.
"""

import argparse
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch

from querysplat_cli.encoders.base import CameraRequest, PosedViews
from querysplat_cli.encoders.holdout import estimate_holdout_cameras
from querysplat_cli.encoders.registry import find_encoder
from querysplat_cli.evaluation.baseline import back_project
from querysplat_cli.model.checkpoints import load
from querysplat_cli.queries.prepare import prepare
from querysplat_cli.reporting.report import machine
from querysplat_cli.reporting.view_scores import score
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.photos import find_photos, load_photos
from querysplat_cli.training.config import load_config
from querysplat_cli.training.data import cache_folder, prepare_samples
from querysplat_cli.training.passes import Sample, read_sample, write_sample
from querysplat_cli.tto.features import optimise_memories
from querysplat_cli.tto.optimise import TtoSettings
from querysplat_cli.tto.plan import LEARNING_RATE, VIEWS_PER_STEP
from querysplat_cli.tto.rendering_loss import RenderingLoss
from reconstruct import SETS, photos_of

SEED = 42
SIZE = 448
"""Longer side of the real sets' pictures by default, as of `reconstruct`."""
UNSEEN = 1000
"""Seed of made-up scenes that nothing is trained on."""


def silent(text: str, fraction: float) -> None:
    pass


def passed(data: Path, name: str, size: int) -> Sample:
    """What the encoder finds of the inputs, and the held-out views."""
    encoder = find_encoder("classical")
    photos, _ = load_photos(find_photos(photos_of(data, name)))
    chosen = estimate_holdout_cameras(
        photos,
        4,
        "joint",
        lambda some: encoder.estimate_cameras(some, CameraRequest(size, SEED), silent),
        poses_known=True,
    ).chosen
    assert chosen.heldout
    inputs = chosen.inputs
    geometry = encoder.estimate_geometry(inputs, seed=SEED, progress=silent)
    return Sample(inputs.views, inputs.cameras, geometry, *chosen.heldout)


def real(data: Path, names: list[str], size: int, folder: Path) -> Iterator[tuple[str, Sample]]:
    for name in names:
        path = folder / f"{name}-{size}.safetensors"
        if not path.is_file():
            write_sample(path, passed(data, name, size))
        yield name, read_sample(path)


def made_up(config: str, count: int, folder: Path) -> Iterator[tuple[str, Sample]]:
    data = load_config(config).data
    source = replace(data.sources[0], seed=UNSEEN, scenes=count)
    data = replace(data, sources=(source,), cache=str(folder))
    prepare_samples(data, lambda: find_encoder(data.encoder), progress=silent)
    for path in sorted(cache_folder(data, source).glob("*.safetensors"))[:count]:
        yield f"made up {path.stem[:6]}", read_sample(path)


def rows(name: str, sample: Sample, models: list[str], steps: list[int], background: float) -> list[dict[str, Any]]:
    def scores(gaussians: Gaussians) -> dict[str, float]:
        return score(gaussians, sample.targets, sample.target_cameras, background).summary()

    assert sample.geometry.depth is not None
    depth = back_project(sample.views, sample.cameras, sample.geometry.depth)
    found = [{"set": name, "row": "depth", "steps": 0, **scores(depth)}]
    posed = PosedViews(sample.views, sample.cameras, torch.zeros(0, 3), ())
    for given in models:
        model = load(given)
        prepared = prepare(model, posed, sample.geometry, queries=None, target="kv")
        for count in steps:
            result = optimise_memories(
                model,
                prepared.variables,
                prepared.anchors,
                RenderingLoss(sample.views, sample.cameras),
                TtoSettings(count, LEARNING_RATE, VIEWS_PER_STEP),
                generator=torch.Generator().manual_seed(SEED),
            )
            found.append({"set": name, "row": given, "steps": count, **scores(result.gaussians)})
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--models", nargs="+", default=["compact"], help="presets or checkpoint files")
    parser.add_argument("--tto", nargs="+", type=int, default=[0, 50], help="steps of test-time optimisation")
    parser.add_argument("--sets", nargs="*", default=SETS)
    parser.add_argument("--max-size", type=int, default=SIZE, help="of the real sets, in pixels")
    parser.add_argument("--made-up", type=int, default=0, metavar="N", help="procedural scenes beside the real sets")
    parser.add_argument("--config", default="small", help="the training whose first source makes them")
    parser.add_argument("--background", type=float, default=0.0, help="grey value of what no Gaussian covers")
    parser.add_argument("--passes", type=Path, help="a folder for what the encoder finds")
    parser.add_argument("--json", type=Path, help="also write the results here")
    arguments = parser.parse_args()
    found: list[dict[str, Any]] = []
    with TemporaryDirectory() as scratch:
        folder = arguments.passes or Path(scratch)
        groups = {
            "made up": made_up(arguments.config, arguments.made_up, folder) if arguments.made_up else iter(()),
            "real": real(arguments.data, arguments.sets, arguments.max_size, folder),
        }
        for group, samples in groups.items():
            for name, sample in samples:
                for row in rows(name, sample, arguments.models, arguments.tto, arguments.background):
                    found.append({"group": group, **row})
                    told(name, row)
    for group, row, steps in dict.fromkeys((each["group"], each["row"], each["steps"]) for each in found):
        these = [each for each in found if (each["group"], each["row"], each["steps"]) == (group, row, steps)]
        means = {key: sum(each[key] for each in these) / len(these) for key in ("psnr", "ssim")}
        told(f"mean {group}", {"row": row, "steps": steps, **means})
    if arguments.json:
        arguments.json.write_text(json.dumps({"machine": machine(), "rows": found}, indent=2) + "\n")


def told(name: str, row: dict[str, Any]) -> None:
    print(f"{name:<14} {row['row']:<40} {row['steps']:>3} {row['psnr']:6.2f} {row['ssim']:.3f}", flush=True)


if __name__ == "__main__":
    main()
