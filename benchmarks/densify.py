"""What splitting Gaussians brings held-out photos in Gaussian space, from scenes of few queries or of the usual ones.

    python benchmarks/densify.py ../shared/data [--passes DIR] [--size 448] [--json FILE]

Every 4th photo is held out, cameras are joint. A scene is made as `reconstruct` makes it (features, automatic steps,
pruned) with a share of the usual queries; then its Gaussians are optimised as by `querysplat tto --space gaussians`. A
run of 300x3 takes 300 steps and splits until there are three times as many; 300x1 splits none, and 450x1 takes about
as long as 300x3. Seconds are the process's own, so that others on the machine hardly count.
"""

import argparse
import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import torch

from feedforward import SEED, SIZE, real
from pruning import pruned_to
from querysplat_cli.encoders.base import PosedViews
from querysplat_cli.model.checkpoints import load
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.queries.prepare import prepare
from querysplat_cli.reporting.report import machine
from querysplat_cli.reporting.view_scores import score
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.training.passes import Sample
from querysplat_cli.tto.features import optimise_memories
from querysplat_cli.tto.gaussians import optimise_gaussians
from querysplat_cli.tto.plan import plan_tto
from querysplat_cli.tto.rendering_loss import RenderingLoss
from reconstruct import SETS

RUNS = ((300, 1.0), (450, 1.0), (300, 3.0))
"""Steps, and times as many Gaussians."""


@dataclass(frozen=True)
class Row:
    """PSNR in dB, held out and of the inputs; `times` as many Gaussians were asked for."""

    set: str
    steps: int
    times: float
    seed: int
    gaussians: int
    psnr: float
    psnr_inputs: float
    cpu_seconds: float


def scene(model: QuerySplat, sample: Sample, share: float) -> Gaussians:
    """A scene of a `share` of the usual queries."""
    posed = PosedViews(sample.views, sample.cameras, torch.zeros(0, 3), ())
    queries = None
    if share < 1:
        usual = prepare(model, posed, sample.geometry, queries=None, target="kv").anchors
        assert usual is not None
        queries = int(share * len(usual.opacities))
    prepared = prepare(model, posed, sample.geometry, queries=queries, target="kv")
    assert prepared.anchors is not None
    (run,) = plan_tto(None, views=len(sample.views), gaussians=prepared.anchors.opacities.numel())
    result = optimise_memories(
        model,
        prepared.variables.map(torch.Tensor.float),
        prepared.anchors,
        RenderingLoss(sample.views, sample.cameras),
        run.settings,
        generator=torch.Generator().manual_seed(SEED),
        pruning=pruned_to("auto", len(sample.views)),
    )
    return result.gaussians.detach()


def further(name: str, start: Gaussians, sample: Sample, steps: int, times: float, seed: int) -> Row:
    target = RenderingLoss(sample.views, sample.cameras)
    gaussians, began = start, time.process_time()
    if steps:
        (run,) = plan_tto(steps, views=len(sample.views), gaussians=len(start), space="gaussians")
        gaussians = optimise_gaussians(
            start,
            target,
            run.settings,
            generator=torch.Generator().manual_seed(seed),
            densify_to=None if times == 1 else round(times * len(start)),
        ).gaussians
    seconds = time.process_time() - began
    heldout = score(gaussians, sample.targets, sample.target_cameras).psnr
    inputs = target.psnr(gaussians, list(range(len(sample.views))))
    return Row(name, steps, times, seed, len(gaussians), heldout, inputs, seconds)


def run_of(text: str) -> tuple[int, float]:
    steps, times = text.split("x")
    return int(steps), float(times)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--sets", nargs="*", default=SETS)
    parser.add_argument("--size", type=int, default=SIZE, help="longer side of the pictures, in pixels")
    parser.add_argument("--share", type=float, default=0.25, help="of the usual queries")
    parser.add_argument("--runs", type=run_of, nargs="*", default=RUNS, metavar="STEPSxTIMES")
    parser.add_argument("--seeds", type=int, nargs="*", default=[1, 2])
    parser.add_argument("--passes", type=Path, help="a folder for what the encoder finds")
    parser.add_argument("--json", type=Path, help="also write the results here")
    arguments = parser.parse_args()
    model = load("compact").requires_grad_(False)
    found: list[Row] = []
    print(f"{'set':<10} {'run':<6} {'seed':>4} {'number':>8} {'dB':>6} {'inputs':>6} {'s':>5}")
    with TemporaryDirectory() as scratch:
        for name, sample in real(arguments.data, arguments.sets, arguments.size, arguments.passes or Path(scratch)):
            start = scene(model, sample, arguments.share)
            runs = [(0, 1.0, 0)] + [(*run, seed) for run in arguments.runs for seed in arguments.seeds]
            for steps, times, seed in runs:
                row = further(name, start, sample, steps, times, seed)
                found.append(row)
                scores = f"{row.gaussians:>8,} {row.psnr:6.2f} {row.psnr_inputs:6.2f} {row.cpu_seconds:5.0f}"
                print(f"{name:<10} {f'{steps}x{times:g}':<6} {seed:>4} {scores}", flush=True)
    if arguments.json:
        results = {
            "machine": machine(),
            "size": arguments.size,
            "share": arguments.share,
            "rows": [asdict(row) for row in found],
        }
        arguments.json.write_text(json.dumps(results, indent=2) + "\n")


if __name__ == "__main__":
    main()
