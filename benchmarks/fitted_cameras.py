"""Held-out cameras fitted to a scene: pose and focal length that make its renders most like the photos."""

import re
from dataclasses import replace

import torch
from torch.nn import functional as F

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.paths import interpolate
from querysplat_cli.scene.rotations import skew
from querysplat_cli.splat.render import render
from querysplat_cli.training.passes import Sample

STEPS, BLURS = 90, (9, 5, 1)
"""Steps of fitting a camera, and the widths in pixels that pictures are averaged over in each third of them."""
RATE, LAST_RATE = 0.02, 0.05
"""Adam's rate, in radians and scene units, and the share of it that is left at the end."""
PATH = 101
"""Cameras on the path between two input cameras, of which one is a start."""


def fitted_cameras(gaussians: Gaussians, sample: Sample) -> Cameras:
    """The held-out cameras that show the scene most like the photos.

    Each starts from its given camera and from one between the inputs; the better result counts. Photos must have
    numbers in their names, which say how far along the path of the camera they were taken.
    """
    place = {name: int(re.findall(r"\d+", name)[-1]) for name in (*sample.views.names, *sample.targets.names)}
    knots = [place[name] for name in sample.views.names]
    best = []
    for row, name in enumerate(sample.targets.names):
        before = max(i for i, knot in enumerate(knots[:-1]) if knot < place[name] or i == 0)
        share = (place[name] - knots[before]) / (knots[before + 1] - knots[before])
        path = interpolate(sample.cameras[[before, before + 1]], PATH)
        starts = sample.target_cameras[[row]], path[[round((PATH - 1) * min(max(share, 0.0), 1.0))]]
        photo, mask = sample.targets.images[[row]], sample.targets.masks[[row]]
        best.append(min((_fit(gaussians, start, photo, mask) for start in starts), key=lambda found: found[0])[1])
    return replace(
        sample.target_cameras, w2c=torch.cat([each.w2c for each in best]), K=torch.cat([each.K for each in best])
    )


def _fit(gaussians: Gaussians, start: Cameras, photo: torch.Tensor, mask: torch.Tensor) -> tuple[float, Cameras]:
    """The least mean squared error of all steps, and its camera. Adam minimises L1 on pictures that become sharper."""
    change = torch.zeros(7, requires_grad=True)
    adam = torch.optim.Adam([change])
    best = (float("inf"), start)
    for step in range(STEPS):
        for group in adam.param_groups:
            group["lr"] = RATE * LAST_RATE ** (step / STEPS)
        camera = _changed(start, change)
        picture = render(gaussians, camera).colour
        with torch.no_grad():
            error = float((picture.clamp(0, 1) - photo).square().mean(1)[mask].mean())
        if error < best[0]:
            best = error, replace(start, w2c=camera.w2c.detach(), K=camera.K.detach())
        width = BLURS[step * len(BLURS) // STEPS]
        loss = F.avg_pool2d(picture - photo, width, 1, width // 2).abs().mean()
        adam.zero_grad()
        loss.backward()
        adam.step()
    return best


def _changed(camera: Cameras, change: torch.Tensor) -> Cameras:
    """The camera after a rotation (3 numbers), a translation (3) and a change of the logarithm of its focal length."""
    turned = torch.linalg.matrix_exp(skew(change[None, :3])) @ camera.w2c[:, :3]
    moved = torch.cat([turned[:, :, :3], turned[:, :, 3:] + change[None, 3:6, None]], 2)
    w2c = torch.cat([moved, camera.w2c[:, 3:]], 1)
    K = torch.cat([camera.K[:, :, :2] * change[6].exp(), camera.K[:, :, 2:]], 2)
    return replace(camera, w2c=w2c, K=K)
