"""What leaving out queries and Gaussians does to held-out photos and to time, on the real sets.

    python benchmarks/pruning.py [DATA] [--passes DIR] [--json FILE]

DATA is the folder of the photo sets, by default $QUERYSPLAT_DATA. Every 4th photo is held out, cameras are joint. Each
set is optimised four times:

- default: as by `reconstruct`, in feature space and for the automatic number of steps;
- a third stays: the same, but a third of the Gaussians are kept;
- all stay: the same, but all Gaussians are kept;
- every block: with a query for every block of 6 pixels, for the number of steps that is automatic there.

Seconds are those from the first step of the optimisation to the last.
"""

from collections.abc import Iterator
from dataclasses import dataclass

from common.arguments import PhotoParser, folder_or_scratch
from common.builds import UNLIMITED, build, optimised_again
from common.output import Table, write_json
from common.photo_sets import Use
from common.samples import SIZE, real_samples
from querysplat_cli.model.checkpoints import load
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.reporting.view_scores import score
from querysplat_cli.runtime.choices import Amount
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.training.passes import Sample
from querysplat_cli.tto.optimise import TtoResult


@dataclass(frozen=True)
class Row:
    """PSNR in dB and SSIM, held out."""

    set: str
    use: Use
    what: str
    steps: int
    seconds: float
    gaussians: int
    psnr: float
    ssim: float


def cases(model: QuerySplat, sample: Sample) -> Iterator[tuple[str, int, Gaussians, TtoResult]]:
    """Each case with its number of steps, its Gaussians, and its run."""
    default = build(model, sample)
    run, result = default.adapted.runs[0]
    yield "default", run.settings.steps, default.adapted.gaussians, result
    assert default.prepared.anchors is not None
    third = default.prepared.anchors.opacities.numel() // 3
    amounts: dict[str, Amount] = {"a third stays": third, "all stay": "off"}
    for what, amount in amounts.items():
        result = optimised_again(model, default, amount)
        yield what, run.settings.steps, result.gaussians, result
    finest = build(model, sample, queries=UNLIMITED)
    run, result = finest.adapted.runs[0]
    yield "every block", run.settings.steps, finest.adapted.gaussians, result


def main() -> None:
    parser = PhotoParser(__doc__)
    options = parser.parse()
    model = load("compact").requires_grad_(False)
    rows: list[Row] = []
    formats = {"set": "", "use": "", "case": "", "steps": "", "s": ".1f", "Gaussians": ",", "dB": ".2f", "SSIM": ".3f"}
    table = Table(formats)
    with folder_or_scratch(options.passes) as folder:
        for photo_set, sample in real_samples(options.data, options.sets, SIZE, folder):
            for what, steps, gaussians, result in cases(model, sample):
                quality = score(gaussians, sample.targets, sample.target_cameras)
                seconds = result.history[-1].seconds
                figures = what, steps, seconds, len(gaussians), quality.psnr, quality.ssim
                rows.append(Row(photo_set.name, photo_set.use, *figures))
                table.add(photo_set.name, photo_set.use, *figures)
    write_json(options.json, rows=rows)


if __name__ == "__main__":
    main()
