"""How far photos agree, pixel by pixel, when some cameras are taken to be theirs."""

from collections.abc import Sequence

from querysplat_cli.encoders.classical.policy import CAMERA_POLICY
from querysplat_cli.encoders.classical.sparse_model import SparseModel, as_posed_views
from querysplat_cli.runtime.compiler import DEPTH_KERNELS, wait_until_compiled
from querysplat_cli.runtime.progress import silent
from querysplat_cli.scene.views import Photo


def dense_agreement(photos: Sequence[Photo], model: SparseModel) -> float:
    """Mean confidence of the depth [0, 1] that small copies of the photos give with the cameras of the model.

    The model has a camera for every photo. With wrong cameras, matches may lie on their epipolar lines, but what is
    around them does not. The share also rises a little with the focal length, so it tells poses apart, not lenses.
    """
    # Imported here: `--help` needs neither the kernels of the depth nor numba.
    from querysplat_cli.encoders.classical.depth import estimate_geometry

    posed = as_posed_views(model, photos, CAMERA_POLICY.agreement_size)
    wait_until_compiled(*DEPTH_KERNELS)
    geometry = estimate_geometry(posed, seed=0, progress=silent)
    assert geometry.confidence is not None
    return float(geometry.confidence.mean())
