"""Held-out quality from twice as far, as far as the photos, and half as far; and over three backgrounds.

    python benchmarks/distances.py [DATA] [--sets NAME ...] [--max-size 448] [--variances 0 0.2] [--json FILE]

DATA is the folder of the photo sets, by default $QUERYSPLAT_DATA. Scenes are made of pictures of --max-size pixels.
Their renders are compared with the held-out photos at half that size, at that size, and at twice of it, over mid-grey.
Photos with fewer pixels than that are left out at twice the size. Each of --variances is that of the 3D smoothing
filter, in px²; 0 is no filter. The same scenes are scored without their backdrop, too. Cameras are joint,
every 4th photo is held out. CPU seconds are those of queries and optimisation.
"""

import time
from argparse import Namespace
from dataclasses import dataclass, replace
from pathlib import Path

from common.arguments import PhotoParser
from common.builds import settings
from common.output import Table, write_json
from common.photo_sets import PHOTO_SETS, PhotoSet, Use
from common.samples import SEED, SIZE, joint_pass
from querysplat_cli.encoders.registry import find_encoder
from querysplat_cli.model.checkpoints import load
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.pipeline.build import build_scene
from querysplat_cli.reporting.view_scores import score
from querysplat_cli.runtime.progress import silent
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.photo_files import large_views, photo_files
from querysplat_cli.scene.views import PhotoSource, Views
from querysplat_cli.splat import smoothing
from querysplat_cli.splat.conventions import MID_GREY

from torch.nn import functional as F

LEAST_VARIANCE = 1e-12
"""What stands for no filter."""
Held = tuple[Views, Cameras]


@dataclass(frozen=True)
class Row:
    """One scene. PSNR (dB) and SSIM over grey by the size relative to the working one; PSNR over black, grey, white."""

    set: str
    use: Use
    variance: float
    distances: dict[str, tuple[float, float] | None]
    backgrounds: list[float]
    without_backdrop: list[float]
    cpu_seconds: float


def halved(held: Held) -> Held:
    """Pictures at half their size, each pixel the mean of four, and their cameras."""
    views, cameras = held
    rows, columns = (size // 2 for size in views.images.shape[2:])
    masks = F.avg_pool2d(views.masks[:, None, : 2 * rows, : 2 * columns].float(), 2)[:, 0] == 1
    images = F.avg_pool2d(views.images[:, :, : 2 * rows, : 2 * columns], 2)
    sizes = tuple((height // 2, width // 2) for height, width in views.sizes)
    K = cameras.K.clone()
    K[:, :2] /= 2
    return replace(views, images=images, masks=masks, sizes=sizes), replace(cameras, K=K, height=rows, width=columns)


def photo_sources(photo_set: PhotoSet, data: Path) -> dict[str, PhotoSource]:
    return {path.name: PhotoSource(path) for path in photo_set.files(data)}


def rows(model: QuerySplat, photo_set: PhotoSet, options: Namespace) -> list[Row]:
    """A row for each variance."""
    encoder = find_encoder("classical")
    chosen = joint_pass(photo_set.photos(options.data), encoder, options.max_size)
    assert chosen.heldout
    views, cameras = held = chosen.heldout
    geometry = encoder.estimate_geometry(chosen.inputs, seed=SEED, progress=silent)
    files = photo_files(views.names, chosen.heldout_photo_cameras, photo_sources(photo_set, options.data))
    sizes: dict[str, Held | None] = {"half": halved(held), "same": held, "double": None}
    if all(max(file.full_size()) >= 2 * options.max_size for file in files):
        sizes["double"] = large_views(files, views, cameras, 2 * options.max_size)
    found = []
    for variance in options.variances:
        smoothing.SMOOTHING_POLICY = smoothing.SmoothingPolicy(variance=max(variance, LEAST_VARIANCE))
        began = time.process_time()
        scene = build_scene(chosen.inputs, geometry, model, settings(backdrop=True))
        seconds = time.process_time() - began
        scores = {name: some and score(scene.gaussians, *some, MID_GREY) for name, some in sizes.items()}
        found.append(
            Row(
                photo_set.name,
                photo_set.use,
                variance,
                {name: each and (each.psnr, each.ssim) for name, each in scores.items()},
                over_three(scene.gaussians, held),
                over_three(replace(scene, backdrop=None).gaussians, held),
                seconds,
            )
        )
    return found


def over_three(gaussians: Gaussians, held: Held) -> list[float]:
    """PSNR over black, grey and white."""
    return [score(gaussians, *held, level).psnr for level in (0.0, MID_GREY, 1.0)]


def main() -> None:
    parser = PhotoParser(__doc__, passes=False)
    parser.add_argument("--max-size", type=int, default=SIZE, help="longer side of the working pictures, in pixels")
    parser.add_argument("--variances", type=float, nargs="*", default=[0.0, smoothing.SmoothingPolicy().variance])
    options = parser.parse()
    model = load("compact").requires_grad_(False)
    names = (
        "half, dB (SSIM)",
        "same, dB (SSIM)",
        "double, dB (SSIM)",
        "black / grey / white, dB",
        "without backdrop, dB",
    )
    table = Table(dict.fromkeys(("set", "use", "px²", *names), "") | {"CPU s": ".0f"})
    found: list[Row] = []
    for name in options.sets:
        for row in rows(model, PHOTO_SETS[name], options):
            found.append(row)
            sizes = (each and f"{each[0]:.2f} ({each[1]:.3f})" for each in row.distances.values())
            levels = (" / ".join(f"{each:.2f}" for each in part) for part in (row.backgrounds, row.without_backdrop))
            table.add(row.set, row.use, row.variance, *sizes, *levels, row.cpu_seconds)
    write_json(options.json, rows=found)


if __name__ == "__main__":
    main()
