"""Target cameras fitted to a finished scene: the pose and focal length whose render is most like the photo.

This leaves errors of the target cameras out of a score. It favours the scene, so that it is never the score of a
protocol. The scene is frozen.
"""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F

from querysplat_cli.evaluation.policy import FITTING_POLICY
from querysplat_cli.evaluation.protocol import rendered_as_release
from querysplat_cli.scene.cameras import Cameras, PhotoCamera
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.undistort import undistorted
from querysplat_cli.scene.views import Photo
from querysplat_cli.splat.render import render

OPAQUE = 0.5
"""Pixels that the scene covers more than this have a depth."""


def fitted_photo_camera(gaussians: Gaussians, camera: PhotoCamera, photo: Photo, size: int) -> PhotoCamera:
    """`camera` after fitting it on the photo, undistorted at a longer side of at most `size`. Its lens stays."""
    views, start = undistorted([photo], [camera], max_size=size)
    with torch.no_grad():
        drawn = render(gaussians, start)
        depths = drawn.depth[drawn.alpha > OPAQUE]
    unit = float(depths.median()) if depths.numel() else 1.0
    _, best = fit_camera(gaussians, start, views.images, views.masks, unit=unit)
    zoom = float(best.K[0, 0, 0] / start.K[0, 0, 0])
    w2c = best.w2c[0].double().numpy()
    return replace(camera, w2c=w2c, focal=(camera.focal[0] * zoom, camera.focal[1] * zoom))


def fit_camera(
    gaussians: Gaussians,
    start: Cameras,
    photo: Float[Tensor, "1 3 height width"],
    mask: Bool[Tensor, "1 height width"],
    *,
    unit: float = 1.0,
) -> tuple[float, Cameras]:
    """The least mean squared error of all steps, and its camera.

    `start` is one camera, of the size of `photo`. `unit` is how far away the scene is, in its own units. Adam minimises
    L1 on pictures that become sharper.
    """
    policy = FITTING_POLICY
    change = torch.zeros(7, requires_grad=True)
    adam = torch.optim.Adam([change])
    best = (float("inf"), start)
    for step in range(policy.steps):
        for group in adam.param_groups:
            group["lr"] = policy.rate * policy.last_rate ** (step / policy.steps)
        camera = _changed(start, change, unit)
        picture = rendered_as_release(gaussians, camera)
        with torch.no_grad():
            error = float((picture.clamp(0, 1) - photo).square().mean(1)[mask].mean())
        if error < best[0]:
            best = error, replace(start, w2c=camera.w2c.detach(), K=camera.K.detach())
        width = policy.blurs[step * len(policy.blurs) // policy.steps]
        loss = F.avg_pool2d((picture - photo) * mask[:, None], width, 1, width // 2).abs().mean()
        adam.zero_grad()
        loss.backward()
        adam.step()
    return best


def _changed(camera: Cameras, change: Float[Tensor, "7"], unit: float) -> Cameras:
    """The camera turned (3 numbers), moved in `unit` (3), and with a focal length times the exponential of the last."""
    return camera.perturbed(change[None, :3], unit * change[None, 3:6]).zoomed(change[6].exp())
