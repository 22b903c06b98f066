"""Photos of a procedural street with their true cameras."""

from pathlib import Path

import torch

from querysplat_cli.scene.formats.transforms import write_cameras
from querysplat_cli.scene.pictures import eight_bit, write_picture
from querysplat_cli.scene.views import Views
from querysplat_cli.training.photographer import cast
from querysplat_cli.training.streets import make_street, stroll

SEED = 5


def take_street(folder: Path, count: int, *, length: float, width: int, samples: int = 2) -> None:
    """Write `count` photos along `length` metres into the new `folder`, and `transforms.json` beside it."""
    folder.mkdir(parents=True)
    height = width * 3 // 4
    cameras = stroll(length, count, SEED, height, width)
    images, _ = cast(make_street(SEED, length), cameras, samples)
    names = tuple(f"{number:04d}.png" for number in range(count))
    for name, image in zip(names, images, strict=True):
        write_picture(folder / name, eight_bit(image.clamp(0, 1)))
    masks = torch.ones(count, height, width, dtype=torch.bool)
    write_cameras(folder.parent / "transforms.json", cameras, Views(images, masks, names, ((height, width),) * count))
