"""What `demo` does: take photos of a procedural scene, and reconstruct them like any others."""

from importlib import resources
from pathlib import Path

import cv2

from querysplat_cli.commands.requests import DemoRequest
from querysplat_cli.pipeline.reconstruct import reconstruct
from querysplat_cli.pipeline.scene_folder import SCENE_FOLDER
from querysplat_cli.pipeline.settings import ReconstructSettings
from querysplat_cli.reporting.report import Report
from querysplat_cli.runtime.progress import Progress, Stages
from querysplat_cli.scene.drafts import put_aside
from querysplat_cli.scene.files import FolderKind, atomic_folder, refuse_existing, without_steps
from querysplat_cli.scene.pictures import eight_bit, write_picture

HOME = FolderKind(("*",))
"""The output folder itself stays, with all other files."""
PHOTOS = FolderKind(tuple(f"photo_{'?' * digits}.jpg" for digits in (2, 3, 4, 5)))


def run_demo(request: DemoRequest, stages: Stages) -> Report:
    """Write JPEG photos to `photos` in the output folder, and their scene to scene.ply beside that.

    The reconstruction gets the pictures alone, without the true cameras or depth. Photos and scene that are there
    already stay as they are if it fails.
    """
    folder = request.output
    refuse_existing([folder], force=request.force, kind=HOME)
    refuse_existing([folder / "photos"], force=request.force, kind=PHOTOS)
    refuse_existing([folder / "scene"], force=request.force, kind=SCENE_FOLDER)
    photos = folder / "photos"
    with put_aside(without_steps(photos)):
        with stages("photograph") as progress, atomic_folder(photos) as draft:
            if (request.photos, request.seed) == (DemoRequest.photos, DemoRequest.seed):
                copy_shipped_photos(draft)
            else:
                take_photos(draft, request.photos, request.seed, progress)
        settings = ReconstructSettings((photos,), folder / "scene.ply", seed=request.seed, force=True)
        return reconstruct(settings, stages)


def copy_shipped_photos(folder: Path) -> None:
    """Those that `take_photos` makes with the default options.

    They are a part of the package, because the ray caster takes ten seconds to compile.
    """
    for photo in (resources.files("querysplat_cli") / "demo_photos").iterdir():
        (folder / photo.name).write_bytes(photo.read_bytes())


def take_photos(folder: Path, count: int, seed: int, progress: Progress) -> None:
    """Ray-cast `count` photos on a walk through a made-up room."""
    # Imported here: numba compiles the ray caster only where it is used.
    from querysplat_cli.training.photographer import cast, walk
    from querysplat_cli.training.rooms import make_room

    scene = make_room(seed)
    cameras = walk(scene, count, seed)
    for i in range(count):
        image = cast(scene, cameras[[i]])[0][0]
        write_picture(folder / f"photo_{i + 1:02d}.jpg", eight_bit(image), [cv2.IMWRITE_JPEG_QUALITY, 95])
        progress("ray casting", (i + 1) / count)
