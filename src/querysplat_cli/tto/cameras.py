"""Camera refinement: cameras are corrected while the scene is optimised."""

import torch
from jaxtyping import Float
from torch import Tensor

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.sim3 import DegenerateAlignment, align_cameras
from querysplat_cli.tto.policy import TTO_POLICY
from querysplat_cli.tto.undoable_adam import UndoableAdam

CAMERA_BETAS = (0.8, 0.95)
"""Of Adam. They are short because a camera takes few steps, one for each time that its view is drawn."""


class RefinedCameras(UndoableAdam):
    """Cameras under small changes: a rotation and a translation of each, and one focal factor for all.

    Changes are measured in pixels, so that one rate suits all. A rotation or translation moves what lies at the view's
    median depth by that many pixels; the focal factor moves the border by that many. The gauge is fixed: after every
    step, a similarity aligns the cameras with those at the start.
    """

    def __init__(self, cameras: Cameras, gaussians: Gaussians) -> None:
        """Raises QuerySplatError where the cameras are not `refinable`."""
        if not refinable(cameras):
            raise QuerySplatError(
                "cameras of one photo, or of photos from one place, cannot be refined", "Use --no-refine-cameras."
            )
        self._start = cameras
        self._depths = _median_depths(cameras, gaussians)
        self._poses = [torch.zeros(6, dtype=torch.float64, requires_grad=True) for _ in range(len(cameras))]
        self._zoom = torch.zeros((), dtype=torch.float64, requires_grad=True)
        rates = dict.fromkeys([*self._poses, self._zoom], 1.0)
        super().__init__(rates, TTO_POLICY.camera_rate, betas=CAMERA_BETAS, fused=False)

    def current(self) -> Cameras:
        """The refined cameras, differentiable in their changes."""
        start = self._start.to(torch.float64)
        poses = torch.stack(self._poses).to(start.w2c.device)
        pixel = 1 / start.K[:, 0, :1]
        zoom = torch.exp(self._zoom.to(start.K.device) / (0.5 * max(start.height, start.width)))
        cameras = start.perturbed(poses[:, :3] * pixel, poses[:, 3:] * pixel * self._depths).zoomed(zoom)
        aligned = cameras.transformed(align_cameras(cameras.w2c.detach(), start.w2c))
        return aligned.to(self._start.w2c.dtype)

    def step(self, share: float) -> None:
        """One step of Adam at `share` of the rate, for the views that were rendered since the last step."""
        for pose in self._poses:
            if pose.grad is not None and not pose.grad.any():
                pose.grad = None  # else momentum would move a camera whose view was not drawn
        super().step(share)


def refinable(cameras: Cameras) -> bool:
    """Whether the cameras fix a similarity: at least two, from different places."""
    try:
        align_cameras(cameras.w2c, cameras.w2c)
    except DegenerateAlignment:
        return False
    return True


def with_refined_focal(others: Cameras, before: Cameras, after: Cameras) -> Cameras:
    """`others` with the focal factor by which `after` differs from `before`.

    Rotations and translations are not applied: refinement leaves the world in place, and `others` belong to it.
    """
    return others.zoomed(after.K[0, 0, 0] / before.K[0, 0, 0])


def _median_depths(cameras: Cameras, gaussians: Gaussians) -> Float[Tensor, "views 1"]:
    """Of the Gaussian centres in each picture, or of all in front of the camera where no centre is in the picture."""
    means, cameras = gaussians.means.detach().double(), cameras.to(torch.float64)
    depths = []
    for view, w2c in enumerate(cameras.w2c):
        z = means @ w2c[2, :3] + w2c[2, 3]
        inside = cameras.sees(means, view)
        seen = z[inside] if inside.any() else z[z > 0]
        depths.append(seen.median() if len(seen) else torch.ones_like(w2c[0, 0]))
    return torch.stack(depths)[:, None]
