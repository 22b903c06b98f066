"""Held-out quality between a few photos: feed-forward, optimised without a guard, and as it is by default.

    python benchmarks/few_views.py ../shared/data [--cases fox4 fox2] [--max-size 160] [--passes DIR] [--json FILE]

Two to four photos make a scene, others between them are held out. Cameras are the dataset's (fox) or those of one pass
over all of these photos (joint); or, in rows called free, the scene's are found from its photos alone and held-out ones
brought to it by a similarity (isolated, as `querysplat eval --cameras free`). Free cameras of so few photos are wrong
together, and held-out ones then do not belong to the scene: a blurred picture in the wrong place scores better than a
sharp one. So these rows are scored a second time, with each held-out camera fitted to the *feed-forward* scene (pose
and focal length, Adam on L1, coarse to fine, from the given camera and from one interpolated between the inputs): in
favour of that scene, and the same camera for all. Without a guard there are as many steps as fit the time, here always
150, and nothing holds what lies between the photos; pruning is the default in both.
"""

import argparse
import json
import re
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from torch.nn import functional as F

from feedforward import SEED, silent
from pruning import pruned_to
from querysplat_cli.encoders.base import CameraRequest, PosedViews
from querysplat_cli.encoders.holdout import select_views
from querysplat_cli.encoders.registry import find_encoder
from querysplat_cli.model.checkpoints import load
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.prune.gaussians import target_count
from querysplat_cli.queries.prepare import prepare
from querysplat_cli.reporting.report import machine
from querysplat_cli.reporting.view_scores import score
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.formats.known import read_known_cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.paths import interpolate
from querysplat_cli.scene.photos import find_photos, load_photos
from querysplat_cli.scene.rotations import skew
from querysplat_cli.splat.render import render
from querysplat_cli.training.passes import Sample, make_sample, read_sample, write_sample
from querysplat_cli.tto.features import optimise_memories
from querysplat_cli.tto.plan import STEPS, plan_tto
from querysplat_cli.tto.rendering_loss import RenderingLoss

HELD_OUT = 4
"""Photos of a case that are held out, evenly spaced among those between its inputs."""
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
FREE = ("fox 2, 6 apart", "fox 4, 14 apart", "fortress 3", "dtu106 2")
FITTING, BLURS = 90, (9, 5, 1)
"""Steps of fitting a camera, and the widths in pixels that pictures are averaged over in each third of them."""


@dataclass(frozen=True)
class Row:
    """PSNR in dB, held out."""

    case: str
    cameras: str
    forward: float
    unguarded: float
    default: float
    steps: int


def photos_of(data: Path, name: str) -> list[Path]:
    return sorted((data / "dl3dv" / "fox" / "images_4" if name == "fox" else data / name / "images").iterdir())


def passed(data: Path, case: str, size: int, *, free: bool) -> Sample:
    name, inputs = CASES[case]
    files = photos_of(data, name)
    between = [i for i in range(inputs[0] + 1, inputs[-1]) if i not in inputs]
    held = {between[round(i * (len(between) - 1) / (HELD_OUT - 1))] for i in range(HELD_OUT)}
    photos, _ = load_photos(find_photos([files[i] for i in sorted({*inputs, *held})]))
    names = [files[i].name for i in inputs]
    encoder = find_encoder("classical")
    if free or name == "fox":
        known = None if free else read_known_cameras(data / "dl3dv" / "fox")
        return make_sample(photos, names, encoder, known=known, max_size=size, seed=SEED)
    everything = encoder.estimate_cameras(photos, CameraRequest(size, SEED), silent)
    rows = [row for row, each in enumerate(everything.views.names) if each in names]
    others = [row for row in range(len(everything.views)) if row not in rows]
    own = select_views(everything, rows)
    geometry = encoder.estimate_geometry(own, seed=SEED, progress=silent)
    return Sample(own.views, own.cameras, geometry, everything.views[others], everything.cameras[others])


def scenes(model: QuerySplat, sample: Sample) -> tuple[int, list[Gaussians]]:
    """Steps by default; feed-forward, optimised without a guard, and by default."""
    posed = PosedViews(sample.views, sample.cameras, torch.zeros(0, 3), ())
    prepared = prepare(model, posed, sample.geometry, queries=None, target="kv")
    variables, anchors = prepared.variables.map(torch.Tensor.float), prepared.anchors
    with torch.no_grad():
        found = [model.decode(variables, anchors)]
    count, views = len(found[0]), len(sample.views)
    plans = [
        plan_tto(steps, views=views, gaussians=count, staying=target_count(count, "auto", sample.cameras))[0].settings
        for steps in (STEPS[1], None)
    ]
    plans[0] = replace(plans[0], keep_cover=False)
    for settings in plans:
        result = optimise_memories(
            model,
            variables,
            anchors,
            RenderingLoss(sample.views, sample.cameras),
            settings,
            generator=torch.Generator().manual_seed(SEED),
            pruning=pruned_to("auto", views),
        )
        found.append(result.gaussians)
    return plans[1].steps, found


def fitted(gaussians: Gaussians, sample: Sample) -> Cameras:
    """The held-out cameras that show the scene most like the photos."""
    place = {name: int(re.findall(r"\d+", name)[-1]) for name in (*sample.views.names, *sample.targets.names)}
    knots = [place[name] for name in sample.views.names]
    best = []
    for row, name in enumerate(sample.targets.names):
        before = max(i for i, knot in enumerate(knots[:-1]) if knot < place[name] or i == 0)
        share = (place[name] - knots[before]) / (knots[before + 1] - knots[before])
        path = interpolate(sample.cameras[[before, before + 1]], 101)
        starts = sample.target_cameras[[row]], path[[round(100 * min(max(share, 0.0), 1.0))]]
        photo, mask = sample.targets.images[[row]], sample.targets.masks[[row]]
        best.append(min((_fit(gaussians, start, photo, mask) for start in starts), key=lambda found: found[0])[1])
    return replace(
        sample.target_cameras, w2c=torch.cat([each.w2c for each in best]), K=torch.cat([each.K for each in best])
    )


def _fit(gaussians: Gaussians, start: Cameras, photo: torch.Tensor, mask: torch.Tensor) -> tuple[float, Cameras]:
    """The least squared error on the way, and its camera."""
    change = torch.zeros(7, requires_grad=True)
    adam = torch.optim.Adam([change])
    best = (float("inf"), start)
    for step in range(FITTING):
        for group in adam.param_groups:
            group["lr"] = 0.02 * 0.05 ** (step / FITTING)
        turned = torch.linalg.matrix_exp(skew(change[None, :3])) @ start.w2c[:, :3]
        moved = torch.cat([turned[:, :, :3], turned[:, :, 3:] + change[None, 3:6, None]], 2)
        w2c = torch.cat([moved, start.w2c[:, 3:]], 1)
        K = torch.cat([start.K[:, :, :2] * change[6].exp(), start.K[:, :, 2:]], 2)
        picture = render(gaussians, replace(start, w2c=w2c, K=K)).colour
        with torch.no_grad():
            error = float((picture.clamp(0, 1) - photo).square().mean(1)[mask].mean())
        if error < best[0]:
            best = error, replace(start, w2c=w2c.detach(), K=K.detach())
        width = BLURS[step * len(BLURS) // FITTING]
        loss = F.avg_pool2d(picture - photo, width, 1, width // 2).abs().mean()
        adam.zero_grad()
        loss.backward()
        adam.step()
    return best


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--cases", nargs="*", default=list(CASES))
    parser.add_argument("--max-size", type=int, default=160)
    parser.add_argument("--passes", type=Path, help="a folder for what the encoder finds")
    parser.add_argument("--json", type=Path, help="also write the results here")
    arguments = parser.parse_args()
    model = load("compact").requires_grad_(False)
    found: list[Row] = []
    with TemporaryDirectory() as scratch:
        folder = arguments.passes or Path(scratch)
        for case in arguments.cases:
            for free in (False, True) if case in FREE else (False,):
                path = folder / f"{case}-{'free' if free else 'known'}-{arguments.max_size}.safetensors"
                if not path.is_file():
                    write_sample(path, passed(arguments.data, case, arguments.max_size, free=free))
                sample = read_sample(path)
                steps, three = scenes(model, sample)
                ways = {"free" if free else "known": sample.target_cameras}
                if free:
                    ways["free, fitted"] = fitted(three[0], sample)
                for way, cameras in ways.items():
                    row = Row(case, way, *(score(some, sample.targets, cameras).psnr for some in three), steps)
                    found.append(row)
                    print(
                        f"| {case} | {way} | {row.forward:.2f} | {row.unguarded:.2f} | {row.default:.2f} |", flush=True
                    )
    if arguments.json:
        results = {"machine": machine(), "rows": [asdict(row) for row in found]}
        arguments.json.write_text(json.dumps(results, indent=2) + "\n")


if __name__ == "__main__":
    main()
