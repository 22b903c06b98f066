"""The kernel against a renderer written a second time, pixel by pixel, from the published equations alone.

It shares no code with the package: matrices by scipy, spherical harmonics by scipy's sph_harm, the Jacobian as
a finite difference of the projection, α and blending in plain Python floats.
"""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from scipy.special import sph_harm_y

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.splat.render import render
from scenes import camera, cloud


def harmonic(degree: int, order: int, direction: np.ndarray) -> float:
    """The real spherical harmonic in 3DGS's sign: scipy's (with the Condon–Shortley phase) real or imaginary part."""
    x, y, z = direction
    value = sph_harm_y(degree, abs(order), math.acos(max(-1.0, min(1.0, z))), math.atan2(y, x))
    if order == 0:
        return float(value.real)
    return math.sqrt(2) * float(value.real if order > 0 else value.imag)


def project(point: np.ndarray, w2c: np.ndarray, K: np.ndarray) -> np.ndarray:
    local = K @ (w2c[:3, :3] @ point + w2c[:3, 3])
    return local[:2] / local[2]


def splats(
    gaussians: Gaussians, w2c: np.ndarray, K: np.ndarray
) -> list[tuple[float, np.ndarray, np.ndarray, float, list[float]]]:
    """Depth, centre, 2D covariance, opacity and colour of what is in front of the camera, nearest first."""
    found = []
    centre = -w2c[:3, :3].T @ w2c[:3, 3]
    for i in range(len(gaussians)):
        mean = gaussians.means[i].numpy()
        z = float(w2c[2, :3] @ mean + w2c[2, 3])
        if z < 0.025:
            continue
        rotation = Rotation.from_quat(gaussians.quats[i].numpy(), scalar_first=True).as_matrix()
        spread = rotation @ np.diag(gaussians.scales[i].numpy() ** 2) @ rotation.T
        step = 1e-6
        slope = np.stack(
            [
                (project(mean + step * axis, w2c, K) - project(mean - step * axis, w2c, K)) / (2 * step)
                for axis in np.eye(3)
            ],
            1,
        )
        direction = (mean - centre) / np.linalg.norm(mean - centre)
        orders = [(degree, order) for degree in range(gaussians.sh_degree + 1) for order in range(-degree, degree + 1)]
        colour = [
            max(0.0, 0.5 + sum(harmonic(*o, direction) * float(gaussians.sh[i, b, c]) for b, o in enumerate(orders)))
            for c in range(3)
        ]
        covariance = slope @ spread @ slope.T + 0.3 * np.eye(2)
        found.append((z, project(mean, w2c, K), covariance, float(gaussians.opacities[i]), colour))
    return sorted(found, key=lambda splat: splat[0])


def picture(gaussians: Gaussians, cameras: Cameras, view: int) -> np.ndarray:
    """[height, width, 3] on black."""
    parts = splats(gaussians, cameras.w2c[view].numpy(), cameras.K[view].numpy())
    inverses = [np.linalg.inv(covariance) for _, _, covariance, _, _ in parts]
    result = np.zeros((cameras.height, cameras.width, 3))
    for y in range(cameras.height):
        for x in range(cameras.width):
            light = 1.0
            for (_, centre, _, opacity, colour), inverse in zip(parts, inverses, strict=True):
                offset = np.array([x + 0.5, y + 0.5]) - centre
                alpha = min(0.99, opacity * math.exp(-0.5 * float(offset @ inverse @ offset)))
                if alpha < 1 / 255:
                    continue
                if light * (1 - alpha) <= 1e-4:
                    break
                result[y, x] += light * alpha * np.array(colour)
                light *= 1 - alpha
    return result


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_the_same_picture(degree: int) -> None:
    cameras = camera(20, 28, views=2)
    scene = cloud(degree, 40, cameras, degree=degree, pixels=3.0)
    found = render(scene.to(torch.float32), cameras).colour
    for view in range(2):
        difference = np.abs(found[view].permute(1, 2, 0).numpy() - picture(scene, cameras, view))
        assert difference.max() < 1 / 255
        assert difference.mean() < 1e-4
