"""What leaving out queries and Gaussians does to held-out photos and to time, on the real sets.

    python benchmarks/pruning.py ../shared/data [--passes DIR] [--json FILE]

Every 4th photo is held out, cameras are joint, optimisation is the default: features, the automatic number of steps.
Each set is optimised as by default, in as many steps with a third of the Gaussians and with all of them, and with a
query for every block of 6 pixels, in the steps that are automatic there.
"""

import argparse
import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

import torch

from feedforward import SEED, SIZE, real
from querysplat_cli.encoders.base import PosedViews
from querysplat_cli.model.checkpoints import load
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.pipeline.memory import evenly_spaced
from querysplat_cli.pipeline.reconstruct import TESTED_VIEWS
from querysplat_cli.prune.gaussians import prune, target_count
from querysplat_cli.queries.prepare import prepare
from querysplat_cli.reporting.report import machine
from querysplat_cli.reporting.view_scores import score
from querysplat_cli.runtime.choices import Amount
from querysplat_cli.training.passes import Sample
from querysplat_cli.tto.features import optimise_memories
from querysplat_cli.tto.optimise import Pruning
from querysplat_cli.tto.plan import QUERIES, plan_tto
from querysplat_cli.tto.rendering_loss import RenderingLoss
from reconstruct import SETS


@dataclass(frozen=True)
class Row:
    set: str
    what: str
    steps: int
    seconds: float
    gaussians: int
    psnr: float
    ssim: float


CASES: dict[str, tuple[int | None, Literal["auto", "off", "third"]]] = {
    "default": (QUERIES, "auto"),
    "a third stays": (QUERIES, "third"),
    "all stay": (QUERIES, "off"),
    "every block": (None, "auto"),
}
"""About how many queries, and what is pruned."""


def pruned_to(amount: Literal["auto"] | int, views: int) -> Pruning:
    tested = evenly_spaced(range(views), TESTED_VIEWS)
    return lambda some, target, steps: prune(
        some, target.cameras, amount, lambda fewer: target.psnr(fewer, tested), steps
    )


def rows(name: str, sample: Sample, model: QuerySplat) -> list[Row]:
    posed = PosedViews(sample.views, sample.cameras, torch.zeros(0, 3), ())
    found = []
    for what, (about, share) in CASES.items():
        prepared = prepare(model, posed, sample.geometry, queries=None, soft_query_limit=about, target="kv")
        assert prepared.anchors is not None
        count = prepared.anchors.opacities.numel()
        amount: Amount = count // 3 if share == "third" else share
        stay = target_count(count, "auto", sample.cameras)
        (run,) = plan_tto(None, views=len(sample.views), gaussians=count, staying=stay)
        start = time.perf_counter()
        result = optimise_memories(
            model,
            prepared.variables.map(torch.Tensor.float),
            prepared.anchors,
            RenderingLoss(sample.views, sample.cameras),
            run.settings,
            generator=torch.Generator().manual_seed(SEED),
            pruning=None if amount == "off" else pruned_to(amount, len(sample.views)),
        )
        seconds = time.perf_counter() - start
        quality = score(result.gaussians, sample.targets, sample.target_cameras)
        row = Row(name, what, run.settings.steps, seconds, len(result.gaussians), quality.psnr, quality.ssim)
        found.append(row)
        print(
            f"{name:<10} {what:<13} {row.steps:>5} {seconds:>5.1f} {row.gaussians:>9,} {row.psnr:6.2f} {row.ssim:.3f}",
            flush=True,
        )
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--sets", nargs="*", default=SETS)
    parser.add_argument("--passes", type=Path, help="a folder for what the encoder finds")
    parser.add_argument("--json", type=Path, help="also write the results here")
    arguments = parser.parse_args()
    model = load("compact").requires_grad_(False)
    print(f"{'set':<10} {'':<13} steps     s Gaussians     dB  SSIM")
    with TemporaryDirectory() as scratch:
        samples = real(arguments.data, arguments.sets, SIZE, arguments.passes or Path(scratch))
        found = [row for name, sample in samples for row in rows(name, sample, model)]
    if arguments.json:
        results = {"machine": machine(), "rows": [asdict(row) for row in found]}
        arguments.json.write_text(json.dumps(results, indent=2) + "\n")


if __name__ == "__main__":
    main()
