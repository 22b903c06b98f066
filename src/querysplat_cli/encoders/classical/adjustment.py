"""The last look at a model: all cameras, points and lenses at once, with outliers held at arm's length."""

from collections import Counter
from copy import deepcopy

import numpy as np
import pycolmap

LOSS_SCALE = 0.5
"""Pixels of reprojection error beyond which the Cauchy loss trusts a feature less and less."""
PAYS = 0.98
"""A second distortion term stays when it lowers the mean error to this share."""
LENS_PHOTOS = 3
"""Photos that a lens needs before it may have a second distortion term."""
LARGEST_DISTORTION = 1.0


def refined(model: pycolmap.Reconstruction, *, fit_lens: bool) -> pycolmap.Reconstruction:
    """The model after bundle adjustment with a robust loss.

    Features scatter by 0.2 px but some are off by pixels; under squares those bend the focal length, which a
    handful of photos of a shallow scene hardly hold. Lenses get RADIAL's second term where it pays.
    """
    plain = _adjusted(model, second_term=False, fit_lens=fit_lens)
    if not fit_lens:
        return plain
    richer = _adjusted(model, second_term=True, fit_lens=True)
    tame = all(np.abs(camera.params[3:]).max() < LARGEST_DISTORTION for camera in richer.cameras.values())
    return richer if tame and _error(richer) < PAYS * _error(plain) else plain


def _adjusted(model: pycolmap.Reconstruction, *, second_term: bool, fit_lens: bool) -> pycolmap.Reconstruction:
    adjusted = deepcopy(model)
    photos = Counter(image.camera_id for image in adjusted.images.values() if image.has_pose)
    for number, camera in adjusted.cameras.items():
        if second_term and photos[number] >= LENS_PHOTOS:
            parameters = [*camera.params, 0.0]
            camera.model = pycolmap.CameraModelId.RADIAL
            camera.params = parameters
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_extra_params = fit_lens
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = LOSS_SCALE
    options.ceres.solver_options.num_threads = 1
    options.ceres.solver_options.max_num_iterations = 50
    options.ceres.solver_options.function_tolerance = 1e-6
    config = pycolmap.BundleAdjustmentConfig()
    for image in adjusted.reg_image_ids():
        config.add_image(image)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    # Not `pycolmap.bundle_adjustment`, which does the same and writes to the terminal at any log level.
    pycolmap.create_default_bundle_adjuster(options, config, adjusted).solve()
    return adjusted


def _error(model: pycolmap.Reconstruction) -> float:
    model.update_point_3d_errors()
    return float(model.compute_mean_reprojection_error())
