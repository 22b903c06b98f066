"""Focal lengths from which structure from motion of many photos starts, where EXIF states none."""

import shutil
from pathlib import Path
from tempfile import TemporaryDirectory

import pycolmap


def calibrate_start(database: Path, folder: Path, *, seed: int) -> None:
    """Give lenses without a prior the focal length that the fundamental matrices of all pairs agree on.

    A start that is far off can cost more than all the rest: of 300 photos of a street, 36 were placed in a bent model
    first, which was discarded. The focal length is the one at which the fundamental matrices are nearest to essential
    ones (Sweeney et al. 2015, "Optimizing the Viewing Graph for Structure-from-Motion"). COLMAP, which finds it, also
    changes the geometries of the pairs, so it works on a copy. Lenses that few pairs measure keep their first guess.
    """
    options = pycolmap.ViewGraphCalibrationOptions()
    options.reestimate_relative_pose = False
    options.random_seed = seed
    with TemporaryDirectory(dir=folder) as scratch:
        copy = shutil.copy(database, scratch)
        if not pycolmap.calibrate_view_graph(copy, options):
            return
        with pycolmap.Database.open(copy) as found, pycolmap.Database.open(database) as store:
            for camera in store.read_all_cameras():
                if not camera.has_prior_focal_length:
                    camera.params = [found.read_camera(camera.camera_id).focal_length, *camera.params[1:]]
                    store.update_camera(camera)
