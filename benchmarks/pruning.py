"""What leaving out queries and Gaussians does to held-out photos and to time, on the real sets.

    python benchmarks/pruning.py [DATA] [--passes DIR] [--json FILE]

DATA is the folder of the photo sets, by default $QUERYSPLAT_DATA. Every 4th photo is held out, cameras are joint. Each
set is optimised four times:

- default: as by `reconstruct --quality draft`, in feature space and for the automatic number of steps;
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
from querysplat_cli.training.passes import Sample
from querysplat_cli.tto.adapt import Adapted


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


def cases(model: QuerySplat, sample: Sample) -> Iterator[tuple[str, Adapted]]:
    """Each case, and what it makes."""
    default = build(model, sample, quality="draft")
    yield "default", default.adapted
    assert default.prepared.anchors is not None
    third = default.prepared.anchors.opacities.numel() // 3
    amounts: dict[str, Amount] = {"a third stays": third, "all stay": "off"}
    for what, amount in amounts.items():
        yield what, optimised_again(model, default, amount)
    yield "every block", build(model, sample, quality="draft", queries=UNLIMITED).adapted


def main() -> None:
    parser = PhotoParser(__doc__)
    options = parser.parse()
    model = load("compact").requires_grad_(False)
    rows: list[Row] = []
    formats = {"set": "", "use": "", "case": "", "steps": "", "s": ".1f", "Gaussians": ",", "dB": ".2f", "SSIM": ".3f"}
    table = Table(formats)
    with folder_or_scratch(options.passes) as folder:
        for photo_set, sample in real_samples(options.data, options.sets, SIZE, folder):
            for what, found in cases(model, sample):
                (run, result), gaussians = found.runs[0], found.gaussians
                quality = score(gaussians, sample.targets, sample.target_cameras)
                cost = run.settings.steps, result.history[-1].seconds, len(gaussians)
                figures = what, *cost, quality.psnr, quality.ssim
                rows.append(Row(photo_set.name, photo_set.use, *figures))
                table.add(photo_set.name, photo_set.use, *figures)
    write_json(options.json, rows=rows)


if __name__ == "__main__":
    main()
