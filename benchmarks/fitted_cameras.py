"""Held-out cameras fitted to a scene: pose and focal length that make its renders most like the photos."""

import re
from dataclasses import replace

from querysplat_cli.evaluation.fitted import fit_camera
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.paths import interpolate
from querysplat_cli.training.passes import Sample

import torch

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
        best.append(min((fit_camera(gaussians, start, photo, mask) for start in starts), key=lambda found: found[0])[1])
    return replace(
        sample.target_cameras, w2c=torch.cat([each.w2c for each in best]), K=torch.cat([each.K for each in best])
    )
