"""Held-out PSNR against seconds of test-time optimisation on the real sets: feature space, Gaussian space, and both.

    python benchmarks/tto_curves.py ../shared/data [--passes DIR] [--figure docs/images/tto_curves.svg] [--json FILE]

Every 4th photo is held out, cameras are those of one pass over all photos (joint). Each curve is one run as
`reconstruct` makes it, pruning included, with cameras as found, by default of the automatic number of steps; it is
scored on the way with the clock stopped. Seconds begin with the feed-forward scene. `--passes DIR` keeps what the
encoder finds.
"""

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, get_args

import torch

from feedforward import SEED, SIZE, real
from pruning import pruned_to
from querysplat_cli.encoders.base import PosedViews
from querysplat_cli.model.checkpoints import load
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.prune.gaussians import target_count
from querysplat_cli.queries.prepare import prepare
from querysplat_cli.reporting.report import machine
from querysplat_cli.reporting.view_scores import score
from querysplat_cli.runtime.choices import Space
from querysplat_cli.runtime.figures import new_figure, save_figure
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.training.passes import Sample
from querysplat_cli.tto.adapt import Start, adapt
from querysplat_cli.tto.plan import QUERIES, TtoRun, plan_tto
from querysplat_cli.tto.rendering_loss import LossAndGradient, RenderingLoss
from reconstruct import SETS

SCORED = (0.1, 0.2, 0.35, 0.5, 0.75)
"""Shares of the steps after which a run is scored, beside its start and its end."""
THROWAWAY = {
    "fortress": ((0, 18.5), (10, 22.0), (20, 22.6), (40, 23.1), (80, 24.1)),
    "dtu106": ((0, 19.7), (10, 21.2), (20, 22.1), (40, 23.3), (60, 24.6)),
    "kermit": ((0, 14.7), (10, 15.5), (20, 16.2), (40, 16.9), (60, 17.2)),
}
"""(seconds, dB) of back-projected depth under plain Adam, measured for this project before it began, on another
day and with its own cameras: a scale, not a contest."""
Point = dict[str, float]


class Watch:
    """Points of a curve, and a clock that stands still while one is measured."""

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


@dataclass(frozen=True)
class WatchedLoss(RenderingLoss):
    """Shows every step's Gaussians to a watch."""

    watch: Watch = field(kw_only=True)

    def value_and_gradient(self, gaussians: Gaussians, chosen: list[int]) -> LossAndGradient:
        self.watch.before_step(gaussians.detach())
        return super().value_and_gradient(gaussians, chosen)


def curve(model: QuerySplat, start: Start, sample: Sample, plan: tuple[TtoRun, ...]) -> list[Point]:
    """Points of one run; the first is the feed-forward scene."""

    def measure(gaussians: Gaussians) -> float:
        return score(gaussians, sample.targets, sample.target_cameras).psnr

    with torch.no_grad():
        first = model.decode(start.variables, start.anchors)
    watch = Watch(sum(run.settings.steps for run in plan), measure)
    watch.point(first)
    target = WatchedLoss(sample.views, sample.cameras, watch=watch)
    adapted = adapt(
        model,
        start,
        target,
        plan,
        generator=torch.Generator().manual_seed(SEED),
        pruning=pruned_to("auto", len(sample.views)),
    )
    watch.point(adapted.gaussians)
    return watch.points


def curves(name: str, sample: Sample, model: QuerySplat, steps: int | None) -> dict[str, Any]:
    posed = PosedViews(sample.views, sample.cameras, torch.zeros(0, 3), ())
    prepared = prepare(model, posed, sample.geometry, queries=None, soft_query_limit=QUERIES, target="kv")
    assert prepared.anchors is not None
    start = Start(prepared.variables.map(torch.Tensor.float), prepared.anchors)
    count = prepared.anchors.opacities.numel()
    stay = target_count(count, "auto", sample.cameras)
    found = {}
    for space in get_args(Space):
        plan = plan_tto(steps, views=len(sample.views), gaussians=count, staying=stay, space=space)
        found[space] = curve(model, start, sample, plan)
        line = "  ".join(f"{point['seconds']:.1f} s {point['psnr']:.2f}" for point in found[space])
        print(f"{name:<10} {space:<10} {line}", flush=True)
    return {"set": name, "inputs": len(sample.views), "heldout": len(sample.targets), "curves": found}


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
            panel.plot(*zip(*THROWAWAY[row["set"]], strict=True), ":", color="grey", label="throwaway, quoted")
        panel.set(title=f"{row['set']}, {row['inputs']} + {row['heldout']} photos", xlabel="seconds of optimisation")
        panel.set(ylabel="held-out PSNR, dB", xlim=(0, None))
        panel.grid(alpha=0.3)
        panel.legend(fontsize=7)
    for empty in axes[len(rows) :]:
        empty.set_axis_off()
    save_figure(figure, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--sets", nargs="*", default=SETS)
    parser.add_argument("--steps", type=int, help="of each run; by default the automatic number")
    parser.add_argument("--passes", type=Path, help="a folder for what the encoder finds")
    parser.add_argument("--figure", type=Path, help="draw the curves here (.svg, .png)")
    parser.add_argument("--json", type=Path, help="also write the results here")
    arguments = parser.parse_args()
    model = load("compact").requires_grad_(False)
    with TemporaryDirectory() as scratch:
        samples = real(arguments.data, arguments.sets, SIZE, arguments.passes or Path(scratch))
        rows = [curves(name, sample, model, arguments.steps) for name, sample in samples]
    if arguments.json:
        arguments.json.write_text(json.dumps({"machine": machine(), "sets": rows}, indent=2) + "\n")
    if arguments.figure:
        draw(rows, arguments.figure)


if __name__ == "__main__":
    main()
