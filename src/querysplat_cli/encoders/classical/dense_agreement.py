"""How far photos agree, pixel by pixel, when some cameras are taken to be theirs."""

from collections.abc import Sequence

import torch

from querysplat_cli.encoders.base import PosedViews
from querysplat_cli.encoders.classical.policy import CAMERA_POLICY
from querysplat_cli.encoders.classical.sparse_model import SparseModel, in_first_camera_frame
from querysplat_cli.runtime.compiler import DEPTH_KERNELS, wait_until_compiled
from querysplat_cli.runtime.progress import silent
from querysplat_cli.scene.undistort import undistorted
from querysplat_cli.scene.views import Photo


def dense_agreement(photos: Sequence[Photo], model: SparseModel) -> float:
    """Mean confidence of the depth [0, 1] that small copies of the photos give with the cameras of the model.

    The model has a camera for every photo. With wrong cameras, matches may lie on their epipolar lines, but what is
    around them does not. The share also rises a little with the focal length, so it tells poses apart, not lenses.
    """
    # Imported here: `--help` needs neither the kernels of the depth nor numba.
    from querysplat_cli.encoders.classical.depth import estimate_geometry

    centred = in_first_camera_frame(model)
    numbers = range(len(photos))
    views, cameras = undistorted(photos, [centred.cameras[i] for i in numbers], max_size=CAMERA_POLICY.agreement_size)
    visibility = tuple(torch.from_numpy(centred.seen[i]) for i in numbers)
    wait_until_compiled(*DEPTH_KERNELS)
    geometry = estimate_geometry(
        PosedViews(views, cameras, torch.from_numpy(centred.points).float(), visibility), seed=0, progress=silent
    )
    assert geometry.confidence is not None
    return float(geometry.confidence.mean())
