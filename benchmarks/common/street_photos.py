"""Photos of a procedural street with their true cameras."""

from pathlib import Path

from common.streets import make_street, stroll
from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.files import atomic_path
from querysplat_cli.scene.formats.transforms import write_transforms
from querysplat_cli.scene.pictures import eight_bit, write_picture
from querysplat_cli.training.photographer import cast

SEED = 5


def take_street(folder: Path, count: int, *, length: float, width: int, samples: int = 2) -> None:
    """Write `count` photos along `length` metres into `folder`, and `transforms.json` beside it.

    Photos that are there already stay.
    """
    folder.mkdir(parents=True, exist_ok=True)
    street, cameras = make_street(SEED, length), stroll(length, count, SEED, width * 3 // 4, width)
    placed = {}
    for number in range(count):
        camera, photo = cameras[[number]], folder / f"{number:04d}.png"
        if not photo.is_file():
            images, _ = cast(street, camera, samples)
            with atomic_path(photo) as draft:
                write_picture(draft, eight_bit(images[0].clamp(0, 1)))
        matrices = camera.w2c[0].numpy(), camera.K[0].numpy()
        placed[photo.name] = PhotoCamera.pinhole(*matrices, camera.height, camera.width)
    write_transforms(folder.parent / "transforms.json", placed)
