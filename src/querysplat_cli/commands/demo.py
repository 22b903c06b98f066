"""The demo: a procedural scene is photographed, and its photos take the ordinary road."""

from pathlib import Path

import cv2

from querysplat_cli.pipeline.reconstruct import reconstruct
from querysplat_cli.pipeline.settings import ReconstructSettings
from querysplat_cli.reporting.report import Report
from querysplat_cli.runtime.progress import Stages
from querysplat_cli.scene.files import atomic_folder, refuse_existing
from querysplat_cli.scene.pictures import eight_bit, write_picture
from querysplat_cli.training.photographer import cast, walk
from querysplat_cli.training.rooms import make_room


def run_demo(folder: Path, *, photos: int, seed: int, force: bool, stages: Stages) -> Report:
    """Write `photos` JPEG files to `folder`/photos and their scene to `folder`/scene.ply.

    Only the pictures are handed on: the reconstruction knows nothing of the true cameras or depth.
    """
    refuse_existing([folder], force=force)
    with stages("photograph") as progress, atomic_folder(folder / "photos") as draft:
        scene = make_room(seed)
        cameras = walk(scene, photos, seed)
        for i in range(photos):
            image = cast(scene, cameras[[i]])[0][0]
            write_picture(draft / f"photo_{i + 1:02d}.jpg", eight_bit(image), [cv2.IMWRITE_JPEG_QUALITY, 95])
            progress("ray casting", (i + 1) / photos)
    settings = ReconstructSettings((folder / "photos",), folder / "scene.ply", seed=seed, force=True)
    return reconstruct(settings, stages)
