"""Held-out quality between a few photos: feed-forward, optimised without a guard, and as it is by default.

    python benchmarks/few_views.py [DATA] [--cases "fox 4, 8 apart" ...] [--max-size 160] [--passes DIR] [--json FILE]

DATA is the folder of the photo sets, by default $QUERYSPLAT_DATA. Two to four photos make a scene, and others between
them are held out. Cameras are those of the dataset (fox) or those of one pass over all of these photos (joint). In
rows called "free" the cameras of the scene are found from its own photos alone, and a similarity brings the held-out
ones to it (isolated, as in `querysplat eval --cameras free`).

Free cameras of so few photos share their errors, and held-out cameras then do not belong to the scene: a blurred
picture in the wrong place scores better than a sharp one. These rows are therefore scored a second time ("free,
fitted"). Each held-out camera is fitted to the *feed-forward* scene, from the given camera and from one between the
inputs. That favours the feed-forward scene, and all three scenes are scored with the same camera.

Without a guard an optimisation takes as many steps as fit the time, here always 150 of the memories, and nothing keeps
what lies between the photos covered. Pruning and dropout are the default in both.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from common.arguments import PhotoParser, folder_or_scratch
from common.builds import build, optimised_again, start_of
from common.output import Table, write_json
from common.photo_sets import PHOTO_SETS, Use
from common.samples import SEED, kept_sample
from fitted_cameras import fitted_cameras
from querysplat_cli.encoders.base import CameraRequest
from querysplat_cli.encoders.holdout import select_views
from querysplat_cli.encoders.registry import find_encoder
from querysplat_cli.model.checkpoints import load
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.reporting.view_scores import score
from querysplat_cli.runtime.progress import silent
from querysplat_cli.scene.formats.known import read_known_cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.photos import find_photos, load_photos
from querysplat_cli.training.captures import Capture
from querysplat_cli.training.passes import Sample, make_sample
from querysplat_cli.tto.features import gaussians_of
from querysplat_cli.tto.policy import TTO_POLICY

HELD_OUT = 4
"""Photos of a case that are held out, at even distances among those between its inputs."""
CASES = {
    "fox 2, 6 apart": ("fox", (10, 16)),
    "fox 2, 12 apart": ("fox", (8, 20)),
    "fox 2, 12 apart, turning": ("fox", (30, 42)),
    "fox 2, 24 apart": ("fox", (12, 36)),
    "fox 4, 8 apart": ("fox", (3, 11, 19, 27)),
    "fox 4, 14 apart": ("fox", (2, 16, 30, 44)),
    "fortress 2": ("fortress", (2, 4)),
    "fortress 3": ("fortress", (0, 3, 6)),
    "dtu106 2": ("dtu106", (8, 12)),
    "dtu106 4": ("dtu106", (2, 7, 12, 17)),
    "kermit 3": ("kermit", (1, 5, 9)),
    "sceaux 4": ("sceaux", (1, 4, 7, 10)),
    "riverview 4": ("riverview", (0, 4, 7, 11)),
}
"""Set and input photos of each case, by their place in the set."""
FREE = ("fox 2, 6 apart", "fox 4, 14 apart", "fortress 3", "dtu106 2")
"""Cases that are also reconstructed with free cameras."""


@dataclass(frozen=True)
class Row:
    """PSNR in dB, held out; `steps` are those of the default on its memories; steps in Gaussian space follow."""

    case: str
    use: Use
    cameras: str
    forward: float
    unguarded: float
    default: float
    steps: int


def case_sample(data: Path, case: str, size: int, *, free: bool) -> Sample:
    """What the encoder finds of the inputs of a case, and its held-out views."""
    name, inputs = CASES[case]
    files = PHOTO_SETS[name].files(data)
    between = [i for i in range(inputs[0] + 1, inputs[-1]) if i not in inputs]
    held = {between[round(i * (len(between) - 1) / (HELD_OUT - 1))] for i in range(HELD_OUT)}
    photos, _ = load_photos(find_photos([files[i] for i in sorted({*inputs, *held})]))
    names = [files[i].name for i in inputs]
    encoder = find_encoder("classical")
    if free or name == "fox":
        known = None if free else read_known_cameras(files[0].parents[1])
        return make_sample(Capture(tuple(photos), tuple(names), known), encoder, max_size=size, seed=SEED)
    everything = encoder.estimate_cameras(photos, CameraRequest(size, SEED), silent)
    rows = [row for row, each in enumerate(everything.views.names) if each in names]
    others = [row for row in range(len(everything.views)) if row not in rows]
    own = select_views(everything, rows)
    geometry = encoder.estimate_geometry(own, seed=SEED, progress=silent)
    return Sample(own.views, own.cameras, geometry, everything.views[others], everything.cameras[others])


def scenes(model: QuerySplat, sample: Sample) -> tuple[int, list[Gaussians]]:
    """Steps by default; feed-forward, optimised without a guard, and by default."""
    default = build(model, sample)
    unguarded = optimised_again(model, default, "auto", steps=TTO_POLICY.most_steps, keep_cover=False)
    forward = gaussians_of(model, start_of(default))
    steps = default.adapted.runs[0][0].settings.steps
    return steps, [forward, unguarded.gaussians, default.gaussians]


def rows(model: QuerySplat, case: str, sample: Sample, *, free: bool) -> Iterator[Row]:
    """The row of a case; with free cameras also the row with fitted ones."""
    steps, three = scenes(model, sample)
    ways = {"free" if free else "known": sample.target_cameras}
    if free:
        ways["free, fitted"] = fitted_cameras(three[0], sample)
    for way, cameras in ways.items():
        scores = (score(some, sample.targets, cameras).psnr for some in three)
        yield Row(case, PHOTO_SETS[CASES[case][0]].use, way, *scores, steps)


def main() -> None:
    parser = PhotoParser(__doc__, sets=False)
    parser.add_argument("--cases", nargs="*", choices=CASES, default=list(CASES), metavar="CASE")
    parser.add_argument("--max-size", type=int, default=160, help="longer side of the pictures, in pixels")
    options = parser.parse()
    model, size = load("compact").requires_grad_(False), options.max_size
    found: list[Row] = []
    kinds = dict.fromkeys(("feed-forward, dB", "without a guard, dB", "default, dB"), ".2f")
    table = Table({"case": "", "use": "", "cameras": "", **kinds})
    with folder_or_scratch(options.passes) as folder:
        for case in options.cases:
            for free in (False, True) if case in FREE else (False,):
                path = folder / f"{case}-{'free' if free else 'known'}-{size}.safetensors"
                sample = kept_sample(path, partial(case_sample, options.data, case, size, free=free))
                for row in rows(model, case, sample, free=free):
                    found.append(row)
                    table.add(case, row.use, row.cameras, row.forward, row.unguarded, row.default)
    write_json(options.json, rows=found)


if __name__ == "__main__":
    main()
