"""Photos of a procedural street with their true cameras, for tests of long runs."""

from pathlib import Path

import cv2
import torch

from querysplat_cli.scene.formats.transforms import write_cameras
from querysplat_cli.scene.views import Views
from querysplat_cli.training.photographer import cast
from querysplat_cli.training.streets import make_street, stroll

LENGTH = 4.0
SEED = 5


def take_street(folder: Path, count: int, width: int = 144) -> Path:
    """Write `count` photos into `folder`, and `transforms.json` beside it, which is returned."""
    folder.mkdir(parents=True)
    height = width * 3 // 4
    cameras = stroll(LENGTH, count, SEED, height, width)
    images, _ = cast(make_street(SEED, LENGTH), cameras, samples=1)
    names = tuple(f"{number:03d}.png" for number in range(count))
    for name, image in zip(names, images, strict=True):
        picture = (image.clamp(0, 1) * 255).round().byte().permute(1, 2, 0).numpy()[..., ::-1]
        cv2.imwrite(str(folder / name), picture)
    poses = folder.parent / "transforms.json"
    masks = torch.ones(count, height, width, dtype=torch.bool)
    write_cameras(poses, cameras, Views(images, masks, names, ((height, width),) * count))
    return poses
