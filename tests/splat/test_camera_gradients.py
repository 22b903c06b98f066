"""Gradients with respect to the cameras: the reference against finite differences, the kernel against the reference."""

from dataclasses import replace

import pytest
import torch
from splat_scenes import as_kernel_sees
from torch import Tensor
from torch.nn import functional as F

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.rotations import skew
from querysplat_cli.splat.render import RenderSettings, render
from scenes import camera, cloud

SMOOTH = RenderSettings(alpha_min=1e-30, transmittance_min=0.0, alpha_max=1.0)


def changed(cameras: Cameras, twists: Tensor, intrinsics: Tensor) -> Cameras:
    """The cameras after a rigid motion [views, 6] in their own frames, and with fx, fy, cx, cy [views, 4] added."""
    generators = F.pad(torch.cat([skew(twists[:, :3]), twists[:, 3:, None]], 2), (0, 0, 0, 1))
    K = cameras.K.clone()
    K[:, [0, 1, 0, 1], [0, 1, 2, 2]] += intrinsics
    return replace(cameras, w2c=torch.linalg.matrix_exp(generators) @ cameras.w2c, K=K)


def functional(gaussians: Gaussians, cameras: Cameras, backend: str, settings: RenderSettings | None) -> Tensor:
    result = render(gaussians, cameras, backend=backend, settings=settings)
    pictures = torch.cat([result.colour, result.alpha[:, None], result.depth[:, None]], 1)
    weights = torch.randn(pictures.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    return (weights * pictures).sum()


def off_centre(height: int, width: int, zoom: float = 1.0) -> Cameras:
    cameras = camera(height, width, views=2)
    K = cameras.K.clone()
    K[:, 0, 0], K[:, 1, 1] = zoom * K[:, 0, 0], 1.1 * zoom * K[:, 1, 1]
    K[:, 0, 2] += 0.1 * width
    return replace(cameras, K=K)


@pytest.mark.parametrize("degree", [0, 2])
def test_the_reference_has_the_gradients_of_finite_differences(degree: int) -> None:
    cameras = off_centre(5, 6)
    scene = cloud(degree, 4, cameras, degree=degree, pixels=1.5, opacity=(0.2, 0.8))
    at = [torch.zeros(2, columns, dtype=torch.float64, requires_grad=True) for columns in (6, 4)]
    assert torch.autograd.gradcheck(
        lambda *change: functional(scene, changed(cameras, *change), "reference", SMOOTH), at, atol=1e-7, rtol=1e-5
    )


@pytest.mark.parametrize(("degree", "zoom", "pixels"), [(0, 1.0, 2.5), (1, 1.0, 2.5), (3, 1.0, 2.5), (1, 4.0, 8.0)])
def test_the_kernel_has_the_gradients_of_the_reference(degree: int, zoom: float, pixels: float) -> None:
    """With zoom, most centres are outside the picture, and the Jacobian of some is clamped."""
    cameras = off_centre(40, 52, zoom)
    scene = as_kernel_sees(cloud(degree, 250, camera(40, 52), degree=degree, pixels=pixels))
    found = {}
    for backend, dtype in (("reference", torch.float64), ("cpu", torch.float32)):
        at = [torch.zeros(2, columns, dtype=torch.float64, requires_grad=True) for columns in (6, 4)]
        loss = functional(scene.to(dtype), changed(cameras, *at), backend, None)
        found[backend] = torch.cat(torch.autograd.grad(loss, at), 1)
    exact = found["reference"]
    # Column by column, since pixels, radians and units of the scene have nothing in common.
    assert ((found["cpu"] - exact).norm(dim=0) <= 1e-4 * exact.norm(dim=0)).all()
