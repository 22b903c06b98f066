"""Rendering errors of the Gaussians equal the reference renderer's gradients, and are zero for a perfect render."""

import torch
from torch import Tensor
from torch.nn import functional as F

from querysplat_cli.model.refiner import ERROR_CHANNELS
from querysplat_cli.queries.policy import QUERY_POLICY
from querysplat_cli.queries.rendering_error import compare, error_gains
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import SH_0, Gaussians
from querysplat_cli.scene.rotations import quaternion_to_matrix
from querysplat_cli.scene.views import Views
from querysplat_cli.splat.blending_weights import blending_weights
from querysplat_cli.splat.render import render


def scene() -> tuple[Gaussians, Cameras]:
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    gaussians = Gaussians(
        means=normal(30, 3) * torch.tensor([1.0, 0.7, 0.4]) + torch.tensor([0.0, 0, 4]),
        quats=F.normalize(normal(30, 4), dim=1),
        scales=0.2 * (0.4 * normal(30, 3)).exp(),
        opacities=torch.rand(30, generator=generator) * 0.8 + 0.1,
        sh=0.4 * normal(30, 1, 3),
    )
    K = torch.tensor([[40.0, 0, 20], [0, 40.0, 15], [0, 0, 1]]).repeat(2, 1, 1)
    w2c = torch.eye(4).repeat(2, 1, 1)
    w2c[1, 0, 3] = 0.3
    return gaussians, Cameras(w2c, K, 30, 40)


def photos(images: Tensor) -> Views:
    count, _, height, width = images.shape
    return Views(images, torch.ones(count, height, width, dtype=torch.bool), ("a", "b"), ((height, width),) * count)


def test_a_scene_that_looks_like_its_photos_has_no_error() -> None:
    gaussians, cameras = scene()
    found = compare(gaussians, photos(render(gaussians, cameras).colour), cameras).errors
    assert found.shape == (30, ERROR_CHANNELS)
    assert found[:, :-1].abs().max() < 1e-3
    torch.testing.assert_close(found[:, -1], (blending_weights(gaussians, cameras) + 1).log() / 4)


def test_it_is_the_descent_of_the_squared_error_by_the_reference_renderer() -> None:
    gaussians, cameras = scene()
    noise = torch.randn(2, 3, 30, 40, generator=torch.Generator().manual_seed(1))
    images = render(gaussians, cameras).colour + 0.05 * noise
    found = compare(gaussians, photos(images), cameras).errors
    exact = gaussians.map(Tensor.double)
    sizes = {"c": 3, "o": 1, "f": 3, "s": 3}
    change = {name: torch.zeros(30, n, dtype=torch.float64).requires_grad_() for name, n in sizes.items()}
    axes = quaternion_to_matrix(exact.quats)
    moved = Gaussians(
        exact.means + torch.einsum("nij,nj->ni", axes, exact.scales * change["f"]),
        exact.quats,
        exact.scales * change["s"].exp(),
        torch.sigmoid(torch.logit(exact.opacities) + change["o"][:, 0]),
        exact.sh + change["c"][:, None] / SH_0,
    )
    picture = render(moved, cameras.to(torch.float64), backend="reference").colour
    (-0.5 * (images.double() - picture).square().sum()).backward()
    pixels = blending_weights(gaussians, cameras).double()[:, None] + 1
    slopes = torch.cat([change[name].grad for name in sizes], 1) / pixels  # type: ignore[misc]
    limit = QUERY_POLICY.largest_error
    expected = (error_gains() * slopes).clamp(-limit, limit)
    torch.testing.assert_close(found[:, :-1].double(), expected, rtol=2e-3, atol=2e-3)
    assert (expected.abs() < limit).float().mean() > 0.9


def test_masked_pixels_do_not_count() -> None:
    gaussians, cameras = scene()
    views = photos(torch.rand(2, 3, 30, 40))
    nothing = Views(views.images, torch.zeros_like(views.masks), views.names, views.sizes)
    assert compare(gaussians, nothing, cameras).errors[:, :-1].abs().max() == 0
