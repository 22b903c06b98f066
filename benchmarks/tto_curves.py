"""Held-out PSNR against seconds of test-time optimisation on the real sets: feature space, Gaussian space, and both.

    python benchmarks/tto_curves.py [DATA] [--passes DIR] [--figure docs/images/tto_curves.svg] [--json FILE]

DATA is the folder of the photo sets, by default $QUERYSPLAT_DATA. Every 4th photo is held out; cameras come from one
pass over all photos (joint). Each curve is one run as `reconstruct --quality draft --tto-space SPACE` makes it, pruning
included, for the automatic number of steps unless --steps is given; its cameras stay as they were found. The run is
scored on the way, and the clock stands still meanwhile. Seconds begin with the feed-forward scene.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

from common.arguments import PhotoParser, folder_or_scratch
from common.builds import settings
from common.output import Table, write_json
from common.photo_sets import PhotoSet
from common.samples import SEED, SIZE, posed, real_samples
from querysplat_cli.model.checkpoints import load
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.pipeline.optimise import optimise_start
from querysplat_cli.pipeline.start import SceneStart, make_start
from querysplat_cli.prune.gaussians import target_count
from querysplat_cli.reporting.view_scores import score
from querysplat_cli.runtime.choices import Space
from querysplat_cli.runtime.figures import new_figure, save_figure
from querysplat_cli.runtime.progress import StageProgress, Stages, silent
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.training.passes import Sample
from querysplat_cli.tto.features import Start
from querysplat_cli.tto.options import OptimiseOptions
from querysplat_cli.tto.plan import TtoRun, plan_tto

import torch

SCORED = (0.1, 0.2, 0.35, 0.5, 0.75)
"""Shares of the steps after which a run is scored. It is also scored at its start and at its end."""
THROWAWAY = {
    "fortress": ((0, 18.5), (10, 22.0), (20, 22.6), (40, 23.1), (80, 24.1)),
    "dtu106": ((0, 19.7), (10, 21.2), (20, 22.1), (40, 23.3), (60, 24.6)),
    "kermit": ((0, 14.7), (10, 15.5), (20, 16.2), (40, 16.9), (60, 17.2)),
}
"""(seconds, dB) of back-projected depth under plain Adam. An experiment measured them before this project began, on
another day and with cameras of its own. They give the scale; they are not a contest."""
Point = dict[str, float]


class Watch:
    """The points of a curve, and a clock that stands still while a point is measured."""

    def __init__(self, steps: int, measure: Callable[[Gaussians], float]) -> None:
        self.points: list[Point] = []
        self._scored = {round(share * steps) for share in SCORED}
        self._measure, self._step, self._paused, self._start = measure, 0, 0.0, time.perf_counter()

    def before_step(self, gaussians: Gaussians) -> None:
        if self._step in self._scored:
            self.point(gaussians)
        self._step += 1

    def point(self, gaussians: Gaussians) -> None:
        now = time.perf_counter()
        seconds = now - self._start - self._paused
        psnr = self._measure(gaussians)
        self.points.append({"step": self._step, "seconds": seconds, "psnr": psnr, "gaussians": len(gaussians)})
        self._paused += time.perf_counter() - now

    def look(self, gaussians: Gaussians, *_: object) -> None:
        """The Gaussians of a step, as `StageProgress` hands them on."""
        self.before_step(gaussians)

    def listen(self, stage: str, text: str, fraction: float) -> None:
        pass


def curve(model: QuerySplat, begun: SceneStart, sample: Sample, plan: tuple[TtoRun, ...]) -> list[Point]:
    """Points of one run; the first is the feed-forward scene."""
    queries, photos = begun.queries, (begun.posed.views, begun.posed.cameras)
    start = Start(queries.variables.map(torch.Tensor.float), queries.anchors)

    def made(runs: tuple[TtoRun, ...], progress: StageProgress) -> Gaussians:
        options = OptimiseOptions(prune="auto", seed=SEED)
        return optimise_start(model, start, photos, runs, options, progress, begun.exposures).gaussians

    def measure(gaussians: Gaussians) -> float:
        return score(gaussians, sample.targets, sample.target_cameras).psnr

    first = made(plan_tto(0, views=len(photos[0]), gaussians=0), StageProgress(silent, None))
    watch = Watch(sum(run.settings.steps for run in plan), measure)
    watch.point(first)
    watch.point(made(plan, StageProgress(silent, watch)))
    return watch.points


def curves(model: QuerySplat, sample: Sample, steps: int | None) -> dict[str, list[Point]]:
    """The curve of each space."""
    begun = make_start(posed(sample), sample.geometry, model, settings(), Stages())
    assert begun.queries.anchors is not None
    count = begun.queries.anchors.opacities.numel()
    kept = target_count(count, "auto", sample.cameras)
    found = {}
    for space in get_args(Space):
        plan = plan_tto(steps, views=len(sample.views), gaussians=count, target_count=kept, space=space)
        found[space] = curve(model, begun, sample, plan)
    return found


def entry(photo_set: PhotoSet, sample: Sample, found: dict[str, list[Point]]) -> dict[str, Any]:
    """A set in the JSON object."""
    views = {"inputs": len(sample.views), "heldout": len(sample.targets)}
    return {"set": photo_set.name, "use": photo_set.use, **views, "curves": found}


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """One panel for each set."""
    columns = min(3, len(rows))
    figure = new_figure(4.2 * columns, 3.2 * -(-len(rows) // columns))
    axes = figure.subplots(-(-len(rows) // columns), columns, squeeze=False).ravel()
    for panel, row in zip(axes, rows, strict=False):
        for space, points in row["curves"].items():
            panel.plot([each["seconds"] for each in points], [each["psnr"] for each in points], ".-", label=space)
        panel.plot(0, row["curves"]["features"][0]["psnr"], "ks", ms=5, label="feed-forward")
        if row["set"] in THROWAWAY:
            panel.plot(*zip(*THROWAWAY[row["set"]], strict=True), ":", color="grey", label="earlier experiment")
        panel.set(title=f"{row['set']} ({row['use']}), {row['inputs']} + {row['heldout']} photos")
        panel.set(xlabel="seconds of optimisation")
        panel.set(ylabel="held-out PSNR, dB", xlim=(0, None))
        panel.grid(alpha=0.3)
        panel.legend(fontsize=7)
    for empty in axes[len(rows) :]:
        empty.set_axis_off()
    save_figure(figure, path)


def main() -> None:
    parser = PhotoParser(__doc__)
    parser.add_argument("--steps", type=int, help="of each run; by default the automatic number")
    parser.add_argument("--figure", type=Path, help="draw the curves here (.svg, .png)")
    options = parser.parse()
    model = load("compact").requires_grad_(False)
    rows = []
    table = Table(dict.fromkeys(("set", "use", "space", "dB after seconds"), ""))
    with folder_or_scratch(options.passes) as folder:
        for photo_set, sample in real_samples(options.data, options.sets, SIZE, folder):
            row = entry(photo_set, sample, curves(model, sample, options.steps))
            rows.append(row)
            for space, points in row["curves"].items():
                text = ", ".join(f"{point['psnr']:.2f} after {point['seconds']:.1f} s" for point in points)
                table.add(photo_set.name, photo_set.use, space, text)
    write_json(options.json, sets=rows)
    if options.figure:
        draw(rows, options.figure)


if __name__ == "__main__":
    main()
