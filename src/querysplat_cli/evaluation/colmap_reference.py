"""COLMAP as it comes, for comparison: default features, exhaustive matching, incremental mapping.

COLMAP's defaults drop models of few photos, and start from wide angles only. Where they place nothing, it gets a second
try that asks for less.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import cv2

from querysplat_cli.runtime.colmap import load_pycolmap
from querysplat_cli.runtime.errors import ImpossibleScene
from querysplat_cli.runtime.progress import Stages
from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.drafts import scratch_folder
from querysplat_cli.scene.formats.colmap import read_colmap
from querysplat_cli.scene.views import Photo

FEWEST_PHOTOS = 2
"""Photos of the smallest model that counts. COLMAP's default is ten, or four fifths of fewer photos."""
LEAST_START_ANGLE = 2.0
"""Degrees between the rays of the first pair's points, in the second try. COLMAP's default is 16."""
FEWEST_INLIERS = 15
"""Matches of the first pair, and of an added photo, in the second try. COLMAP's defaults are 100 and 30."""


def estimate_with_colmap(photos: Sequence[Photo], *, seed: int, stages: Stages) -> dict[str, PhotoCamera]:
    """Cameras by photo name of COLMAP's largest model; photos of one size share a lens.

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
        one_size = len({(photo.height, photo.width) for photo in photos}) == 1
        modes = pycolmap.CameraMode
        with stages("features"):
            pycolmap.extract_features(database, pictures, camera_mode=modes.SINGLE if one_size else modes.AUTO)
        with stages("matching"):
            pycolmap.match_exhaustive(database)
        found = None
        with stages("mapping"):
            for options in (_defaults(), _modest()):
                found = found or pycolmap.incremental_mapping(database, pictures, models, options)
        if not found:
            raise ImpossibleScene("COLMAP places no two of the photos", "Add photos that overlap more.")
        largest = max(found.values(), key=lambda model: model.num_reg_images())
        largest.write_binary(models)
        # The pictures are upright, and have names of ours.
        return {
            names[name]: replace(camera, file=names[name], as_stored=False)
            for name, camera in read_colmap(models).items()
        }


def _defaults() -> Any:
    options = load_pycolmap().IncrementalPipelineOptions()
    options.min_model_size = FEWEST_PHOTOS
    return options


def _modest() -> Any:
    """For few photos, and for photos from nearly one direction."""
    options = _defaults()
    options.mapper.init_min_tri_angle = LEAST_START_ANGLE
    options.mapper.init_min_num_inliers = FEWEST_INLIERS
    options.mapper.abs_pose_min_num_inliers = FEWEST_INLIERS
    return options
