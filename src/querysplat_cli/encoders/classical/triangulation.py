"""Scene points for cameras that are given."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pycolmap

from querysplat_cli.encoders.classical.mapping import from_colmap
from querysplat_cli.encoders.classical.matches import Matches
from querysplat_cli.encoders.classical.sparse_model import SparseModel
from querysplat_cli.scene.cameras import PhotoCamera, rescaled


def triangulated(cameras: Sequence[PhotoCamera], matches: Matches, *, seed: int) -> SparseModel:
    """The given cameras, one for each photo, with the points that the matches make.

    The cameras come back in pixels of the photos at the size of the matches; their poses are kept.
    """
    scaled = [rescaled(camera, *size) for camera, size in zip(cameras, matches.sizes, strict=True)]
    if not matches.pairs:
        return SparseModel(
            dict(enumerate(scaled)), np.zeros((0, 3)), {i: np.zeros(0, np.int64) for i in range(len(scaled))}
        )
    with pycolmap.Database.open(matches.database) as store:
        reconstruction = pycolmap.Reconstruction()
        for camera in store.read_all_cameras():
            reconstruction.add_camera_with_trivial_rig(camera)
        for image in store.read_all_images():
            w2c = pycolmap.Rigid3d(cameras[image.image_id - 1].w2c[:3])
            reconstruction.add_image_with_trivial_frame(image, w2c)
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = 1
    options.random_seed = seed
    options.triangulation.ignore_two_view_tracks = False
    with TemporaryDirectory(dir=matches.folder) as folder:
        found = from_colmap(
            pycolmap.triangulate_points(reconstruction, matches.database, matches.folder, Path(folder), options=options)
        )
    return replace(found, cameras=dict(enumerate(scaled)))
