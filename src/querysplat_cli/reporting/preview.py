"""A picture of photos beside renders over grey, which shows the scene without a viewer."""

from pathlib import Path

import cv2
import numpy as np
import torch

from querysplat_cli.runtime.sequences import evenly_spaced
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.pictures import eight_bit, write_picture
from querysplat_cli.scene.views import Views
from querysplat_cli.splat.conventions import MID_GREY
from querysplat_cli.splat.render import render

PREVIEW_ROWS = 4
PREVIEW_GAP = 6


def preview(gaussians: Gaussians, groups: dict[str, tuple[Views, Cameras]]) -> np.ndarray:
    """A picture [height, width, 3] (8-bit RGB): for each group, up to four views, photo left and render right.

    The views of a group are evenly spaced. Each pair has a caption.
    """
    strips = []
    for caption, (views, cameras) in groups.items():
        rows = evenly_spaced(range(len(views)), PREVIEW_ROWS)
        with torch.no_grad():
            renders = render(gaussians, cameras[rows], background=torch.full((3,), MID_GREY)).colour.clamp(0, 1)
        for row, picture in zip(rows, renders, strict=True):
            height, width = views.sizes[row]
            pair = [eight_bit(image[:, :height, :width]) for image in (views.images[row], picture)]
            gap = np.full((height, PREVIEW_GAP, 3), 255, np.uint8)
            strips.append(_captioned(np.hstack([pair[0], gap, pair[1]]), f"{caption}: {views.names[row]}"))
    widest = max(strip.shape[1] for strip in strips)
    padded = [
        np.pad(strip, ((0, PREVIEW_GAP), (0, widest - strip.shape[1]), (0, 0)), constant_values=255) for strip in strips
    ]
    return np.vstack(padded)


def write_preview(path: Path, gaussians: Gaussians, groups: dict[str, tuple[Views, Cameras]]) -> None:
    write_picture(path, preview(gaussians, groups))


def _captioned(picture: np.ndarray, caption: str) -> np.ndarray:
    bar = np.full((22, picture.shape[1], 3), 255, np.uint8)
    text = caption.encode("ascii", "replace").decode()
    cv2.putText(bar, f"{text} (photo | render)", (6, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 0), 1, cv2.LINE_AA)
    return np.vstack([bar, picture])
