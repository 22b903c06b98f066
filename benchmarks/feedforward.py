"""Held-out quality of checkpoints on the real sets, before and after test-time optimisation, beside splatted depth.

    python benchmarks/feedforward.py [DATA] --models compact initial.safetensors --tto 0 50 [--json FILE]

DATA is the folder of the photo sets, by default $QUERYSPLAT_DATA. Every 4th photo is held out; cameras come from one
pass over all photos (joint). The encoder works once for each set, and every model and number of steps reads what it
found; `--passes DIR` keeps that. What `reconstruct` adds to a model is left out: scenes have as many queries as the
photos need, all Gaussians and SH bands stay, and nothing guards what lies between a few photos. With `--backdrop` there
is what it puts behind everything, so that scores hardly depend on the background.

`--made-up N` adds N procedural scenes. They are made as those of the training `--config`, but with a seed that no
training uses.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import mean

from common.arguments import PhotoParser, folder_or_scratch
from common.builds import UNLIMITED, build, optimised_again
from common.output import Table, write_json
from common.photo_sets import PhotoSet, Use
from common.samples import SIZE, real_samples
from querysplat_cli.encoders.registry import find_encoder
from querysplat_cli.evaluation.baseline import back_project
from querysplat_cli.model.checkpoints import load
from querysplat_cli.reporting.view_scores import score
from querysplat_cli.runtime.progress import silent
from querysplat_cli.scene.gaussians import Gaussians, joined
from querysplat_cli.training.config import load_config
from querysplat_cli.training.data import cache_folder, prepare_samples
from querysplat_cli.training.passes import Sample, read_sample

UNSEEN = 1000
"""Seed of made-up scenes that nothing is trained on."""
FORMATS = {"set": "", "use": "", "scene from": "", "steps": "", "dB": ".2f", "SSIM": ".3f"}


@dataclass(frozen=True)
class Row:
    """PSNR in dB and SSIM, held out, of a scene from depth (`row`) or from a model after so many steps."""

    group: str
    set: str
    use: Use
    row: str
    steps: int
    psnr: float
    ssim: float


def made_up(config: str, count: int, folder: Path) -> Iterator[tuple[PhotoSet, Sample]]:
    data = load_config(config).data
    source = replace(data.sources[0], seed=UNSEEN, scenes=count)
    data = replace(data, sources=(source,), cache=str(folder))
    prepare_samples(data, lambda: find_encoder(data.encoder), progress=silent)
    for path in sorted(cache_folder(data, source).glob("*.safetensors"))[:count]:
        yield PhotoSet(f"made up {path.stem[:6]}", "only reported", str(path)), read_sample(path)


def scenes(sample: Sample, models: list[str], steps: list[int], backdrop: bool) -> Iterator[tuple[str, int, Gaussians]]:
    """Splatted depth, and the scene of each model after each number of steps."""
    assert sample.geometry.depth is not None
    yield "depth", 0, back_project(sample.views, sample.cameras, sample.geometry.depth)
    for name in models:
        model = load(name).requires_grad_(False)
        scene = build(model, sample, tto=0, prune="off", queries=UNLIMITED)
        for count in steps:
            again = optimised_again(model, scene, "off", steps=count, keep_cover=False) if count else scene
            behind = (scene.inputs.backdrop(again.gaussians),) if backdrop else ()
            yield name, count, joined(again.gaussians, *behind)


def show_means(table: Table, found: list[Row]) -> None:
    """Means over the real sets that constants were tuned on, over the others, and over the made-up scenes."""
    for group, use, name, steps in dict.fromkeys((row.group, row.use, row.row, row.steps) for row in found):
        these = [row for row in found if (row.group, row.use, row.row, row.steps) == (group, use, name, steps)]
        psnr, ssim = mean(row.psnr for row in these), mean(row.ssim for row in these)
        table.add(f"mean, {group}", use, name, steps, psnr, ssim)


def main() -> None:
    parser = PhotoParser(__doc__)
    parser.add_argument("--models", nargs="+", default=["compact"], help="presets or checkpoint files")
    parser.add_argument("--tto", nargs="+", type=int, default=[0, 50], help="steps of test-time optimisation")
    parser.add_argument("--max-size", type=int, default=SIZE, help="of the real sets, in pixels")
    parser.add_argument("--made-up", type=int, default=0, metavar="N", help="procedural scenes beside the real sets")
    parser.add_argument("--config", default="small", help="the training whose first source makes them")
    parser.add_argument("--background", type=float, default=0.0, help="grey value of what no Gaussian covers")
    parser.add_argument("--backdrop", action="store_true", help="put the far Gaussians of `reconstruct` behind models")
    options = parser.parse()
    found: list[Row] = []
    table = Table(FORMATS)
    with folder_or_scratch(options.passes) as folder:
        groups = {"real": real_samples(options.data, options.sets, options.max_size, folder)}
        if options.made_up:
            groups = {"made up": made_up(options.config, options.made_up, folder), **groups}
        for group, samples in groups.items():
            for photo_set, sample in samples:
                for name, steps, gaussians in scenes(sample, options.models, options.tto, options.backdrop):
                    quality = score(gaussians, sample.targets, sample.target_cameras, options.background)
                    scores = round(quality.psnr, 3), round(quality.ssim, 4)
                    row = Row(group, photo_set.name, photo_set.use, name, steps, *scores)
                    found.append(row)
                    table.add(row.set, row.use, row.row, row.steps, row.psnr, row.ssim)
    show_means(table, found)
    write_json(options.json, rows=found)


if __name__ == "__main__":
    main()
