"""What `demo` does: render photos of a procedural scene, and reconstruct them like any others."""

import cv2

from querysplat_cli.commands.requests import DemoRequest
from querysplat_cli.pipeline.reconstruct import reconstruct
from querysplat_cli.pipeline.settings import ReconstructSettings
from querysplat_cli.reporting.report import Report
from querysplat_cli.runtime.progress import Stages
from querysplat_cli.scene.files import atomic_folder, refuse_existing
from querysplat_cli.scene.pictures import eight_bit, write_picture
from querysplat_cli.training.photographer import cast, walk
from querysplat_cli.training.rooms import make_room


def run_demo(request: DemoRequest, stages: Stages) -> Report:
    """Write JPEG photos to `photos` in the output folder, and their scene to scene.ply beside that.

    The reconstruction gets the pictures alone, without the true cameras or depth.
    """
    folder = request.output
    refuse_existing([folder], force=request.force)
    with stages("photograph") as progress, atomic_folder(folder / "photos") as draft:
        scene = make_room(request.seed)
        cameras = walk(scene, request.photos, request.seed)
        for i in range(request.photos):
            image = cast(scene, cameras[[i]])[0][0]
            write_picture(draft / f"photo_{i + 1:02d}.jpg", eight_bit(image), [cv2.IMWRITE_JPEG_QUALITY, 95])
            progress("ray casting", (i + 1) / request.photos)
    settings = ReconstructSettings((folder / "photos",), folder / "scene.ply", seed=request.seed, force=True)
    return reconstruct(settings, stages)
