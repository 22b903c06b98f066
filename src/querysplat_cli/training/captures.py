"""What a source of training scenes gives: photos of one scene, some of which are inputs."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.views import Photo
from querysplat_cli.training.config import SourceSettings


@dataclass(frozen=True)
class Capture:
    """Photos of one scene in the order in which they were taken, the names of the inputs, and cameras where known."""

    photos: tuple[Photo, ...]
    inputs: tuple[str, ...]
    known: Mapping[str, PhotoCamera] | None


def drawn_views(
    chance: np.random.Generator, settings: SourceSettings, frames: int
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Ascending numbers of the inputs and of the targets among `frames` frames.

    Inputs are an interval apart; targets lie between the first and the last of them, and up to an interval beyond.
    Raises QuerySplatError when there are too few frames.
    """
    fewest, most = settings.inputs
    fitting = [n for n in range(fewest, most + 1) if n < frames]
    if not fitting:
        raise QuerySplatError(f"{frames} frames are too few for {fewest} inputs and a target")
    count = int(chance.choice(fitting))
    widest = max(1, (frames - 1) // max(count - 1, 1))
    low = min(settings.interval[0], widest)
    interval = int(chance.integers(low, min(settings.interval[1], widest) + 1))
    start = int(chance.integers(0, frames - (count - 1) * interval))
    inputs = tuple(start + i * interval for i in range(count))
    around = range(max(0, start - interval), min(frames, inputs[-1] + interval + 1))
    others = [frame for frame in around if frame not in inputs] or [i for i in range(frames) if i not in inputs]
    picked = chance.choice(others, min(settings.targets, len(others)), replace=False)
    return inputs, tuple(sorted(int(frame) for frame in picked))
