"""The pictures of a case in NerfBaselines' layout of predictions, so that others can compute the scores again.

info.json                      what was run; scores of the rounded pictures
color/<group>/<photo>.png      renders, rounded to 8 bits
gt-color/<group>/<photo>.png   what they are compared with, rounded to 8 bits
"""

from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from querysplat_cli.evaluation.judge import ViewScore
from querysplat_cli.evaluation.metrics import METRICS, Meter
from querysplat_cli.scene.files import write_json
from querysplat_cli.scene.formats.dataset import Frame
from querysplat_cli.scene.pictures import distinct_stems, eight_bit, write_picture

ROUNDING = (
    "pictures are rounded to 8 bits; metrics.json beside this folder has the scores of the pictures before rounding"
)


def write_predictions(
    folder: Path,
    about: Mapping[str, Any],
    views: Mapping[str, Sequence[ViewScore]],
    truth: Callable[[Frame], Tensor],
    meter: Meter,
) -> None:
    """Write `views` by group into `folder`, which NerfBaselines' `evaluate` reads. `about` says what was run."""
    scores: dict[str, dict[str, float | None]] = {}
    for group, members in views.items():
        for view, stem in zip(members, distinct_stems([view.frame.name for view in members]), strict=True):
            name = f"{group}/{stem}.png"
            render, photo = (eight_bit(image) for image in (view.picture, truth(view.frame)))
            write_picture(folder / "color" / name, render)
            write_picture(folder / "gt-color" / name, photo)
            rounded = (torch.from_numpy(pixels).permute(2, 0, 1).float() / 255 for pixels in (render, photo))
            scores[name] = dict(zip(METRICS, meter.plain(*rounded), strict=True))
    info = {
        "method": "querysplat",
        "method_version": version("querysplat"),
        "evaluation_protocol": "default",
        "render_dataset_metadata": {"color_space": "srgb", "background_color": None},
        "rounding": ROUNDING,
        "querysplat": {**about, "scores": scores},
    }
    write_json(folder / "info.json", info)
