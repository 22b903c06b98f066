"""What colour transforms bring on the real sets, with the photos as they are and with made changes of exposure.

    python benchmarks/exposure.py [DATA] [--sets fox] [--stops 0 0.8] [--json FILE]

DATA is the folder of the photo sets, by default $QUERYSPLAT_DATA. Every 4th photo is held out. Structure from motion
over all photos finds the cameras. Every photo is then exposed at random by up to --stops more or less, in linear light,
and its channels by a tenth of that (standard deviation), clipped and rounded to 8 bits. Depth is found with these
photos. The scene is made twice: with `--exposure auto`, and with `off`.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from time import process_time

from common.arguments import PhotoParser
from common.builds import settings
from common.output import Table, write_json
from common.photo_sets import PHOTO_SETS, PhotoSet, Use
from common.samples import SEED, joint_pass
from querysplat_cli.encoders.registry import find_encoder
from querysplat_cli.model.checkpoints import load
from querysplat_cli.pipeline.build import build_scene
from querysplat_cli.reporting.view_scores import score
from querysplat_cli.runtime.progress import silent
from querysplat_cli.scene.pictures import linear_of_srgb
from querysplat_cli.scene.views import Views

import torch


@dataclass(frozen=True)
class Row:
    """One scene: the disagreement of its photos (None with `off`), its scores held out, its CPU seconds."""

    set: str
    use: Use
    stops: float
    exposure: str
    disagreement: float | None
    corrected: bool
    heldout: dict[str, float]
    seconds: float


def exposed(views: Views, stops: float, random: torch.Generator) -> Views:
    """The photos at other exposures."""
    gains = 2 ** (stops * (2 * torch.rand(len(views), 1, generator=random) - 1))
    balance = torch.exp(stops / 10 * torch.randn(len(views), 3, generator=random))
    images = views.images
    linear = torch.from_numpy(linear_of_srgb(images.numpy()))
    linear = (linear * (gains * balance)[:, :, None, None]).clamp(0, 1)
    photos = torch.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear.clamp_min(1e-6) ** (1 / 2.4) - 0.055)
    return replace(views, images=(photos * 255).round() / 255 if stops else images)


def rows(photo_set: PhotoSet, data: Path, stops: list[float]) -> Iterator[Row]:
    """For each amount, the scene with `auto` and the one with `off`."""
    model, encoder = load("compact").requires_grad_(False), find_encoder("classical")
    true = joint_pass(photo_set.photos(data), encoder, encoder.size)
    assert true.heldout
    for amount in stops:
        random = torch.Generator().manual_seed(SEED)
        posed = replace(true.inputs, views=exposed(true.inputs.views, amount, random))
        heldout = exposed(true.heldout[0], amount, random), true.heldout[1]
        geometry = encoder.estimate_geometry(posed, seed=SEED, progress=silent)
        for exposure in ("auto", "off"):
            began = process_time()
            scene = build_scene(posed, geometry, model, settings(exposure=exposure))
            seconds = process_time() - began
            disagreement = scene.colours.disagreement if scene.colours else None
            scores = score(scene.gaussians, *heldout).summary()
            corrected = scene.exposures is not None
            yield Row(photo_set.name, photo_set.use, amount, exposure, disagreement, corrected, scores, seconds)


def main() -> None:
    parser = PhotoParser(__doc__, passes=False)
    parser.add_argument("--stops", nargs="+", type=float, default=[0.0, 0.8])
    options = parser.parse()
    table = Table(
        {
            "set": "",
            "use": "",
            "± stops": ".1f",
            "`--exposure`": "",
            "disagreement": ".1%",
            "dB": ".2f",
            "dB corrected": ".2f",
            "SSIM corrected": ".3f",
            "dB half": ".2f",
            "CPU seconds": ".0f",
        }
    )
    found = []
    for name in options.sets:
        for row in rows(PHOTO_SETS[name], options.data, options.stops):
            found.append(row)
            exposure = f"{row.exposure}: {'on' if row.corrected else 'off'}" if row.exposure == "auto" else "off"
            scores = (row.heldout[key] for key in ("psnr", "psnr_cc", "ssim_cc", "psnr_half"))
            table.add(row.set, row.use, row.stops, exposure, row.disagreement, *scores, row.seconds)
    write_json(options.json, rows=found)


if __name__ == "__main__":
    main()
