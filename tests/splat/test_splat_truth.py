"""The reference against finite differences and closed forms; the compiled kernel against the reference."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from splat_scenes import as_kernel_sees, assert_agree, outcome

from querysplat_cli.runtime.errors import MissingPart, QuerySplatError
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.splat.blending_weights import blending_weights, three_blending_weights
from querysplat_cli.splat.projection import colours
from querysplat_cli.splat.render import RenderSettings, render
from scenes import FIELDS, camera, cloud

SMOOTH = RenderSettings(alpha_min=1e-30, transmittance_min=0.0, alpha_max=1.0)
"""No cut-off is reached, so that finite differences are exact."""


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_gradients_of_the_reference_are_its_finite_differences(degree: int) -> None:
    cameras = camera(5, 6, views=2)
    scene = cloud(degree, 3, cameras, degree=degree, pixels=1.5, opacity=(0.2, 0.8))
    leaves = [getattr(scene, name).clone().requires_grad_() for name in FIELDS]

    weights = torch.randn(4, 2, 5, 5, 6, generator=torch.Generator().manual_seed(9), dtype=torch.float64)

    def functionals(*fields: torch.Tensor) -> torch.Tensor:
        result = render(Gaussians(*fields), cameras, backend="reference", settings=SMOOTH)
        pictures = torch.cat([result.colour, result.alpha[:, None], result.depth[:, None]], 1)
        return (weights * pictures).sum((1, 2, 3, 4))

    assert torch.autograd.gradcheck(functionals, leaves, atol=1e-7, rtol=1e-5)


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_one_round_gaussian_has_its_closed_form(backend: str) -> None:
    cameras = camera(9, 9)
    focal, z, scale, opacity = float(cameras.K[0, 0, 0]), 3.0, 1.2, 0.7
    one = Gaussians(
        torch.tensor([[0.0, 0.0, z]], dtype=torch.float64),
        torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64),
        torch.full((1, 3), scale, dtype=torch.float64),
        torch.tensor([opacity], dtype=torch.float64),
        torch.tensor([[[1.0, 0.0, -1.0]]], dtype=torch.float64),
    )
    at = torch.arange(9, dtype=torch.float64) + 0.5 - 4.5
    squared = at[:, None] ** 2 + at**2
    alpha = opacity * torch.exp(-squared / (2 * ((focal * scale / z) ** 2 + 0.3)))
    colour = torch.tensor([0.5 + 0.28209479177387814, 0.5, 0.5 - 0.28209479177387814], dtype=torch.float64)
    background = torch.tensor([0.1, 0.2, 0.3])
    got = render(one.to(torch.float64 if backend == "reference" else torch.float32), cameras, backend=backend,
                 background=background)  # fmt: skip
    expected = colour[:, None, None] * alpha + background.double()[:, None, None] * (1 - alpha)
    torch.testing.assert_close(got.alpha[0].double(), alpha, rtol=0, atol=3e-6)
    torch.testing.assert_close(got.colour[0].double(), expected, rtol=0, atol=3e-6)
    torch.testing.assert_close(got.depth[0].double(), torch.full_like(alpha, z), rtol=3e-6, atol=0)


def test_spherical_harmonics_are_orthonormal_but_for_the_sign() -> None:
    """∫ basis_i·basis_j over the sphere is δ_ij: checks every constant of degree 0 to 3."""
    cos, weight = (torch.from_numpy(a) for a in np.polynomial.legendre.leggauss(8))
    turn = torch.arange(16, dtype=torch.float64) * (2 * math.pi / 16)
    sin = (1 - cos**2).sqrt()
    directions = torch.stack(
        [sin[:, None] * turn.cos(), sin[:, None] * turn.sin(), cos[:, None].expand(-1, 16)], -1
    ).reshape(-1, 3)
    weights = (weight[:, None] * (2 * math.pi / 16)).expand(-1, 16).reshape(-1)
    values = []
    for band in range(16):
        sh = torch.zeros(len(directions), 16, 3, dtype=torch.float64)
        sh[:, band] = 0.05  # small enough that 0.5 + sh·basis stays positive
        values.append((colours(sh, directions)[:, 0] - 0.5) / 0.05)
    basis = torch.stack(values)
    torch.testing.assert_close((basis * weights) @ basis.T, torch.eye(16, dtype=torch.float64), rtol=0, atol=1e-12)


@settings(max_examples=15)
@given(
    seed=st.integers(0, 10_000),
    count=st.integers(1, 120),
    degree=st.integers(0, 3),
    height=st.integers(1, 40),
    width=st.integers(1, 40),
    views=st.integers(1, 3),
    pixels=st.sampled_from([0.2, 1.0, 3.0, 30.0]),
)
def test_kernel_agrees_with_the_reference(
    seed: int, count: int, degree: int, height: int, width: int, views: int, pixels: float
) -> None:
    cameras = camera(height, width, views=views)
    assert_agree(cloud(seed, count, cameras, degree=degree, pixels=pixels), cameras, flips=0.01, gradient=1e-3)


@pytest.mark.parametrize("seed", range(4))
def test_kernel_agrees_tightly_where_no_alpha_is_at_a_cut_off(seed: int) -> None:
    cameras = camera(40, 52, views=2)
    assert_agree(cloud(seed, 250, cameras, degree=seed), cameras, gradient=2e-5)


@pytest.mark.parametrize("alpha_max", [0.99, 0.999])
def test_kernel_agrees_on_opaque_scenes_where_pixels_stop_early(alpha_max: float) -> None:
    cameras = camera(40, 40)
    scene = cloud(5, 500, cameras, opacity=(0.97, 1.0), pixels=4.0)
    assert_agree(scene, cameras, settings=RenderSettings(alpha_max=alpha_max), gradient=3e-5)


def test_no_gradient_passes_through_the_alpha_cap() -> None:
    cameras = camera(1, 1)
    one = Gaussians(
        torch.tensor([[0.0, 0, 3]]), torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), 9.0), torch.ones(1),
        torch.zeros(1, 1, 3),
    )  # fmt: skip
    for backend in ("reference", "cpu"):
        found = outcome(one, cameras, backend)
        assert float(found.rendering.alpha.max()) == pytest.approx(0.99)
        assert found.gradients["opacities"].abs().max() == 0
        assert found.gradients["sh"].abs().max() > 0


def test_views_are_independent_of_the_views_beside_them() -> None:
    cameras = camera(33, 30, views=3)
    scene = cloud(2, 150, cameras).to(torch.float32)
    together = render(scene, cameras)
    for v in range(3):
        alone = render(scene, cameras[v : v + 1])
        assert torch.equal(together.colour[v], alone.colour[0])
        assert torch.equal(together.depth[v], alone.depth[0])


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_contributions_are_the_blending_weights(backend: str) -> None:
    cameras = camera(24, 31, views=2)
    scene = cloud(3, 80, cameras)
    scene = scene if backend == "reference" else scene.to(torch.float32)
    with torch.no_grad():
        weights = blending_weights(scene, cameras)
    alpha = render(scene, cameras, backend=backend).alpha
    assert weights.min() >= 0
    torch.testing.assert_close(weights.sum(), alpha.sum(), rtol=1e-4, atol=0)
    without = render(scene[weights < weights.median()], cameras, backend=backend).alpha
    assert without.sum() < alpha.sum()


def test_three_weights_of_pixels_at_once_are_those_of_one_after_another() -> None:
    cameras = camera(24, 31)
    scene = cloud(3, 80, cameras).to(torch.float32)
    pixels = torch.rand(3, 24, 31, generator=torch.Generator().manual_seed(0))
    alone = torch.stack([three_blending_weights(scene, cameras, each.expand(3, -1, -1))[0] for each in pixels])
    assert three_blending_weights(scene, cameras, pixels).equal(alone)


def test_auto_takes_the_reference_for_float64_and_the_kernel_otherwise() -> None:
    cameras = camera(8, 8)
    scene = cloud(0, 5, cameras)
    assert render(scene, cameras).colour.dtype == torch.float64
    assert render(scene.to(torch.float32), cameras).colour.dtype == torch.float32


def test_an_unknown_backend_is_refused() -> None:
    with pytest.raises(QuerySplatError, match="no splatter named 'vulkan'"):
        render(cloud(0, 5, camera(8, 8)), camera(8, 8), backend="vulkan")


@pytest.mark.skipif(torch.cuda.is_available(), reason="tells what happens without CUDA")
def test_gsplat_names_what_is_missing() -> None:
    with pytest.raises(MissingPart):
        render(cloud(0, 5, camera(8, 8)).to(torch.float32), camera(8, 8), backend="gsplat")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_gsplat_renders_the_same_picture() -> None:
    pytest.importorskip("gsplat")
    cameras = camera(40, 52, views=2)
    scene = as_kernel_sees(cloud(1, 400, cameras))
    exact = render(scene, cameras, backend="reference", settings=RenderSettings(alpha_max=0.999))
    found = render(scene.to(torch.float32).to("cuda"), cameras.to("cuda"), backend="gsplat")
    torch.testing.assert_close(found.colour.cpu().double(), exact.colour, rtol=0, atol=1 / 255)


def test_fields_of_different_lengths_are_refused() -> None:
    scene = cloud(0, 5, camera(8, 8)).to(torch.float32)
    object.__setattr__(scene, "quats", scene.quats[:4])  # past the annotations, which only tests check
    with pytest.raises(QuerySplatError, match=r"quats \[4, 4\]"):
        render(scene, camera(8, 8))


def test_cameras_may_have_another_precision() -> None:
    cameras: Cameras = camera(12, 12)
    scene = cloud(0, 20, cameras)
    torch.testing.assert_close(
        render(scene, cameras.to(torch.float32)).colour, render(scene, cameras).colour, rtol=0, atol=1e-5
    )
