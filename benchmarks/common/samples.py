"""Photo sets as the benchmarks use them: input views with cameras and geometry, and held-out views in the same frame.

Every 4th photo is held out. Cameras come from one pass over all photos ("joint").
"""

from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path

from common.photo_sets import PHOTO_SETS, PhotoSet
from querysplat_cli.encoders.base import CameraRequest, Encoder, PosedViews
from querysplat_cli.encoders.holdout import PosedSplit, estimate_holdout_cameras
from querysplat_cli.encoders.registry import find_encoder
from querysplat_cli.runtime.progress import silent
from querysplat_cli.scene.photos import find_photos, load_photos
from querysplat_cli.training.passes import Sample, read_sample, write_sample

import torch

SEED = 42
SIZE = 448
"""Longer side of the pictures by default, in pixels, as of `reconstruct`."""
HOLDOUT_EVERY = 4


def joint_pass(photos: list[Path], encoder: Encoder, size: int = SIZE) -> PosedSplit:
    """Cameras of inputs and held-out photos from one pass over all of them."""
    loaded, _ = load_photos(find_photos(photos), progress=silent)
    return estimate_holdout_cameras(
        loaded,
        HOLDOUT_EVERY,
        "joint",
        lambda some: encoder.estimate_cameras(some, CameraRequest(size, SEED), silent),
        poses_known=True,  # there is no second pass then
    ).split


def joint_sample(photos: list[Path], size: int = SIZE) -> Sample:
    """What the classical encoder finds of the inputs, and the held-out views."""
    encoder = find_encoder("classical")
    chosen = joint_pass(photos, encoder, size)
    assert chosen.heldout
    inputs = chosen.inputs
    geometry = encoder.estimate_geometry(inputs, seed=SEED, progress=silent)
    return Sample(inputs.views, inputs.cameras, geometry, *chosen.heldout)


def kept_sample(path: Path, make: Callable[[], Sample]) -> Sample:
    """The sample in the file `path`, which is made where it is missing."""
    if not path.is_file():
        path.parent.mkdir(parents=True, exist_ok=True)
        write_sample(path, make())
    return read_sample(path)


def real_samples(data: Path, names: Iterable[str], size: int, folder: Path) -> Iterator[tuple[PhotoSet, Sample]]:
    """The named sets, one after another; `folder` keeps what the encoder found."""
    for name in names:
        chosen = PHOTO_SETS[name]
        path = folder / f"{name.replace('/', '-')}-{size}.safetensors"
        yield chosen, kept_sample(path, partial(joint_sample, chosen.photos(data), size))


def posed(sample: Sample) -> PosedViews:
    """The input views with their cameras, and no sparse points."""
    return PosedViews(sample.views, sample.cameras, torch.zeros(0, 3), ())
