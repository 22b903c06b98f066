"""COLMAP as it comes, for comparison: default features, exhaustive matching, incremental mapping."""

from collections.abc import Sequence

import cv2

from querysplat_cli.runtime.colmap import load_pycolmap
from querysplat_cli.runtime.errors import ImpossibleScene
from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.drafts import scratch_folder
from querysplat_cli.scene.formats.colmap import read_colmap
from querysplat_cli.scene.views import Photo


def estimate_with_colmap(photos: Sequence[Photo], *, seed: int) -> dict[str, PhotoCamera]:
    """Cameras by photo name of COLMAP's largest model; photos share a lens where COLMAP finds that they do.

    Raises ImpossibleScene when it places no two photos.
    """
    pycolmap = load_pycolmap()
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    pycolmap.set_random_seed(seed)
    with scratch_folder() as scratch:
        pictures, database, models = (scratch / name for name in ("pictures", "matches.db", "models"))
        models.mkdir()
        names = {}
        for number, photo in enumerate(photos):
            file = pictures / f"{number:06d}.png"
            file.parent.mkdir(exist_ok=True)
            cv2.imwrite(str(file), photo.pixels[..., ::-1])
            names[file.name] = photo.name
        pycolmap.extract_features(database, pictures, camera_mode=pycolmap.CameraMode.SINGLE)
        pycolmap.match_exhaustive(database)
        found = pycolmap.incremental_mapping(database, pictures, models)
        if not found:
            raise ImpossibleScene("COLMAP places no two of the photos", "Add photos that overlap more.")
        largest = max(found.values(), key=lambda model: model.num_reg_images())
        largest.write_binary(models)
        return {names[name]: camera for name, camera in read_colmap(models).items()}
