"""Where the photos were taken from."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch

from querysplat_cli.encoders.base import Located
from querysplat_cli.encoders.classical.mapping import map_photos
from querysplat_cli.encoders.classical.matches import Matches, matched
from querysplat_cli.encoders.classical.sparse_model import SparseModel, normalised
from querysplat_cli.encoders.classical.undistort import undistorted
from querysplat_cli.errors import ImpossibleScene
from querysplat_cli.progress import Progress
from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.views import LeftOut, Photo


def locate(
    photos: Sequence[Photo],
    *,
    max_size: int,
    seed: int,
    progress: Progress,
    known: Mapping[str, PhotoCamera] | None = None,
) -> Located:
    with matched(photos, seed=seed, progress=progress) as matches:
        progress("placing cameras", 0.5)
        model = map_photos(matches, seed=seed)
    if model is None:
        raise ImpossibleScene("no two photos could be related")
    return _located(photos, normalised(model), max_size=max_size)


def _located(photos: Sequence[Photo], model: SparseModel, *, max_size: int) -> Located:
    used = list(model.cameras)
    views, cameras = undistorted([photos[i] for i in used], [model.cameras[i] for i in used], max_size=max_size)
    return Located(
        views,
        cameras,
        torch.from_numpy(model.points).float(),
        tuple(torch.from_numpy(model.seen[i]) for i in used),
    )
