"""Photos of made-up rooms, and options that make a scene of them quickly."""

from pathlib import Path

import cv2

from querysplat_cli.training.photographer import cast, walk
from querysplat_cli.training.rooms import make_room

PHOTOS = 7
HEIGHT, WIDTH = 336, 448
SMALL = ["--max-size", "192", "--tto", "24", "--quiet"]


def take_photos(
    folder: Path, seed: int, count: int = PHOTOS, *, mirrored: bool = False, size: tuple[int, int] = (HEIGHT, WIDTH)
) -> list[Path]:
    """Photos of a procedural room. Rooms share patterns, but a mirrored room matches none that is not."""
    folder.mkdir(parents=True, exist_ok=True)
    scene = make_room(seed)
    cameras = walk(scene, count, seed).resized(*size)
    files = [folder / f"room{seed}_{i}.png" for i in range(count)]
    for i, file in enumerate(files):
        picture = (cast(scene, cameras[[i]], samples=1)[0][0] * 255).round().byte().permute(1, 2, 0).numpy()[..., ::-1]
        cv2.imwrite(str(file), picture[:, ::-1] if mirrored else picture)
    return files
