"""What splitting Gaussians brings held-out photos in Gaussian space, from scenes of few queries or of the usual number.

    python benchmarks/densify.py [DATA] [--passes DIR] [--size 448] [--json FILE]

DATA is the folder of the photo sets, by default $QUERYSPLAT_DATA. Every 4th photo is held out, cameras are joint. A
scene is made as `reconstruct --quality draft` makes it, with a share of the usual number of queries. Then its Gaussians
are optimised as by `querysplat tto --space gaussians`. A run of 300x3 takes 300 steps and splits until there are three
times as many Gaussians. A run of 300x1 splits none, and one of 450x1 takes about as long as 300x3. Seconds are those of
the process, so that other work on the machine hardly counts.
"""

import time
from dataclasses import dataclass

from common.arguments import PhotoParser, folder_or_scratch
from common.builds import build
from common.output import Table, write_json
from common.photo_sets import PhotoSet, Use
from common.samples import SEED, SIZE, posed, real_samples
from querysplat_cli.model.checkpoints import load
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.pipeline.build import BuiltScene
from querysplat_cli.pipeline.optimise import rendering_target
from querysplat_cli.queries.prepare import prepare
from querysplat_cli.reporting.view_scores import score
from querysplat_cli.training.passes import Sample
from querysplat_cli.tto.gaussians import optimise_gaussians
from querysplat_cli.tto.options import OptimiseOptions
from querysplat_cli.tto.plan import plan_tto
from querysplat_cli.tto.policy import TTO_POLICY

import torch


@dataclass(frozen=True)
class Run:
    """So many steps, until there are `times` as many Gaussians; `seed` draws the views."""

    steps: int = 0
    times: float = 1.0
    seed: int = 0

    def __str__(self) -> str:
        return f"{self.steps}x{self.times:g}"


RUNS = (Run(300), Run(450), Run(300, 3.0))


@dataclass(frozen=True)
class Row:
    """PSNR in dB, held out and of the inputs; `times` as many Gaussians were asked for."""

    set: str
    use: Use
    steps: int
    times: float
    seed: int
    gaussians: int
    psnr: float
    psnr_inputs: float
    cpu_seconds: float


def scene(model: QuerySplat, sample: Sample, share: float) -> BuiltScene:
    """A scene of a `share` of the usual queries."""
    queries = None
    if share < 1:
        usual = prepare(
            model, posed(sample), sample.geometry, queries=None, soft_query_limit=TTO_POLICY.queries, target="kv"
        ).anchors
        assert usual is not None
        queries = int(share * len(usual.opacities))
    return build(model, sample, quality="draft", queries=queries)


def further(photo_set: PhotoSet, before: BuiltScene, sample: Sample, run: Run) -> Row:
    """The scene after `run`."""
    start, views, cameras = before.gaussians, before.posed.views, before.adapted.cameras
    target = rendering_target(views, cameras, OptimiseOptions(seed=SEED), before.exposures, official=False)
    gaussians, began = start, time.process_time()
    if run.steps:
        (plan,) = plan_tto(run.steps, views=len(views), gaussians=len(start), space="gaussians")
        gaussians = optimise_gaussians(
            start,
            target,
            plan.settings,
            generator=torch.Generator().manual_seed(run.seed),
            densify_to=None if run.times == 1 else round(run.times * len(start)),
        ).gaussians
    seconds = time.process_time() - began
    return Row(
        photo_set.name,
        photo_set.use,
        run.steps,
        run.times,
        run.seed,
        len(gaussians),
        psnr=score(gaussians, sample.targets, sample.target_cameras).psnr,
        psnr_inputs=target.psnr(gaussians, list(range(len(views)))),
        cpu_seconds=seconds,
    )


def run_of(text: str) -> Run:
    steps, times = text.split("x")
    return Run(int(steps), float(times))


def main() -> None:
    parser = PhotoParser(__doc__)
    parser.add_argument("--size", type=int, default=SIZE, help="longer side of the pictures, in pixels")
    parser.add_argument("--share", type=float, default=0.25, help="of the usual number of queries")
    parser.add_argument("--runs", type=run_of, nargs="*", default=RUNS, metavar="STEPSxTIMES")
    parser.add_argument("--seeds", type=int, nargs="*", default=[1, 2])
    options = parser.parse()
    model = load("compact").requires_grad_(False)
    runs = [Run(), *(Run(run.steps, run.times, seed) for run in options.runs for seed in options.seeds)]
    rows: list[Row] = []
    formats = {"set": "", "use": "", "run": "", "seed": "", "Gaussians": ",", "dB": ".2f", "inputs, dB": ".2f"}
    table = Table(formats | {"CPU, s": ".0f"})
    with folder_or_scratch(options.passes) as folder:
        for photo_set, sample in real_samples(options.data, options.sets, options.size, folder):
            start = scene(model, sample, options.share)
            for run in runs:
                row = further(photo_set, start, sample, run)
                rows.append(row)
                scores = row.gaussians, row.psnr, row.psnr_inputs, row.cpu_seconds
                table.add(row.set, row.use, str(run), row.seed, *scores)
    write_json(options.json, size=options.size, share=options.share, rows=rows)


if __name__ == "__main__":
    main()
