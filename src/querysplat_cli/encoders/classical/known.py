"""Points for cameras that somebody else has found."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pycolmap

from querysplat_cli.encoders.classical.mapping import from_colmap
from querysplat_cli.encoders.classical.matches import Matches
from querysplat_cli.encoders.classical.sparse_model import SparseModel, rescaled
from querysplat_cli.scene.cameras import PhotoCamera, same_shape
from querysplat_cli.scene.formats.transforms import is_rigid
from querysplat_cli.scene.views import LeftOut, Photo


def match_cameras(
    photos: Sequence[Photo], known: Mapping[str, PhotoCamera]
) -> tuple[dict[int, PhotoCamera], list[LeftOut]]:
    """The given cameras by photo number, and the photos that have no usable one."""
    cameras, left_out = {}, []
    for number, photo in enumerate(photos):
        camera = known.get(photo.name)
        fault = _fault(photo, camera) if camera else "no camera is given for it"
        if camera and not fault:
            u, _, vt = np.linalg.svd(camera.w2c[:3, :3])
            w2c = np.array(camera.w2c, dtype=np.float64)
            w2c[:3, :3] = u @ vt
            cameras[number] = replace(camera, w2c=w2c)
        else:
            left_out.append(LeftOut(photo.name, fault))
    return cameras, left_out


def triangulated(cameras: Sequence[PhotoCamera], matches: Matches, *, seed: int) -> SparseModel:
    """The given cameras, one for each photo and scaled to the size of the matches, with the points that these make."""
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
    return SparseModel(dict(enumerate(scaled)), found.points, found.seen)


def _fault(photo: Photo, camera: PhotoCamera) -> str:
    if not is_rigid(camera.w2c):
        return "its given camera is no rigid motion"
    if not same_shape((photo.height, photo.width), (camera.height, camera.width)):
        return f"it is {photo.width} × {photo.height}, its given camera {camera.width} × {camera.height}"
    return ""
