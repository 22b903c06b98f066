"""Head outputs to Gaussians: closed forms, saturation, and the prior at an output of zero."""

import math

import pytest
import torch
from model_scenes import anchors, compact

from querysplat_cli.model.config import preset
from querysplat_cli.model.heads import (
    activate_appearance,
    activate_geometry,
    assemble,
    assemble_anchored,
    signed_exponential,
)
from querysplat_cli.scene.gaussians import SH_0
from querysplat_cli.scene.rotations import quaternion_product, quaternion_to_matrix

OFFICIAL = preset("official-8192")
EXTREMES = [0.0, -0.0, 1e-30, 1.0, -1.0, 39.9, -41.0, 1e4, -1e4]


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-14), (torch.float32, 1e-6)])
def test_signed_exponential_and_its_slope(dtype: torch.dtype, tolerance: float) -> None:
    x = torch.tensor([-3.0, -1e-9, 0.0, 1e-9, 2.5, 30.0], dtype=dtype, requires_grad=True)
    y = signed_exponential(x)
    (slope,) = torch.autograd.grad(y.sum(), x)
    torch.testing.assert_close(y, x.sign() * torch.expm1(x.abs()), rtol=tolerance, atol=0)
    torch.testing.assert_close(slope, x.abs().exp(), rtol=tolerance, atol=0)


def test_signed_exponential_continues_as_its_tangent_where_it_would_overflow() -> None:
    x = torch.tensor([-50.0, 45.0], requires_grad=True)
    (slope,) = torch.autograd.grad(signed_exponential(x).sum(), x)
    torch.testing.assert_close(slope, torch.full((2,), math.exp(40)))
    torch.testing.assert_close(signed_exponential(x), torch.tensor([-11.0, 6.0]) * math.exp(40))


def test_official_raw_zero() -> None:
    made = assemble(torch.zeros(1, 10), torch.zeros(1, 13), OFFICIAL)
    torch.testing.assert_close(made.means, torch.tensor([[0.0, 0, 1]]))
    torch.testing.assert_close(made.scales, torch.full((1, 3), 0.075 / math.e))
    assert not made.quats.any()
    torch.testing.assert_close(made.opacities, torch.tensor([1 / (1 + math.exp(2))]))
    assert not made.sh.any()


def test_scale_cap_and_colour_bounds() -> None:
    raw = torch.zeros(2, 10)
    raw[:, 3:6] = torch.tensor([[0.999], [1.001]])
    _, scale, _ = activate_geometry(raw, OFFICIAL)
    assert float(scale[0, 0]) == pytest.approx(0.075 * math.exp(-0.001), rel=1e-6)
    assert float(scale[1, 0]) == pytest.approx(0.075, rel=1e-6)
    sh, _ = activate_appearance(torch.full((1, 13), 50.0), OFFICIAL)
    torch.testing.assert_close(0.5 + SH_0 * sh[0, 0], torch.ones(3))
    torch.testing.assert_close(sh[0, 1:], torch.full((3, 3), 0.1))


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("kind", ["official", "anchored"])
def test_extreme_raw_numbers_stay_finite_with_their_gradients(dtype: torch.dtype, kind: str) -> None:
    """Row 27 of docs/reference/stability-cases.md: raw numbers saturate."""
    config = compact()
    scene = anchors(config, queries=len(EXTREMES))
    count = len(EXTREMES) * config.gaussians_per_query
    values = torch.tensor(EXTREMES).repeat_interleave(config.gaussians_per_query)[:, None].to(dtype)
    geometry = values.expand(count, 10).clone().requires_grad_()
    appearance = values.expand(count, 13).clone().requires_grad_()
    made = (
        assemble(geometry, appearance, OFFICIAL)
        if kind == "official"
        else assemble_anchored(geometry, appearance, scene, config)
    )
    parts = list(made.__dict__.values())
    slopes = torch.autograd.grad([part.float().sum() for part in parts], (geometry, appearance))
    for part in (*parts, *slopes):
        assert part.isfinite().all()
    assert (made.opacities >= 0).all()
    assert (made.opacities <= 1).all()


def test_raw_zero_gives_the_prior_and_a_slope_to_every_raw_number() -> None:
    config = compact()
    scene = anchors(config)
    count = len(scene) * config.gaussians_per_query
    raw = [torch.zeros(count, 10, requires_grad=True), torch.zeros(count, 13, requires_grad=True)]
    made = assemble_anchored(*raw, scene, config)
    assert torch.equal(made.means, scene.means.flatten(0, 1))
    assert torch.equal(made.scales, scene.scales.flatten(0, 1))
    torch.testing.assert_close(made.quats, scene.quats.flatten(0, 1), rtol=1e-6, atol=1e-7)
    torch.testing.assert_close(made.opacities, scene.opacities.flatten(), rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(0.5 + SH_0 * made.sh[:, 0], scene.colours.flatten(0, 1), rtol=1e-6, atol=1e-6)
    assert not made.sh[:, 1:].any()
    parts = list(made.__dict__.values())
    generator = torch.Generator().manual_seed(0)
    given = [torch.randn(part.shape, generator=generator) for part in parts]
    geometry, appearance = torch.autograd.grad(parts, raw, given)
    # The real part of a quaternion's change is only its length, to which a rotation is blind.
    assert (geometry[:, [0, 1, 2, 3, 4, 5, 7, 8, 9]] != 0).all()
    assert (appearance != 0).all()


def test_centres_move_in_units_of_spacing_and_rotations_turn_in_the_anchors_frame() -> None:
    config = compact()
    scene = anchors(config)
    raw = torch.zeros(len(scene) * config.gaussians_per_query, 10)
    raw[:, 0] = math.log(3)
    raw[:, 6], raw[:, 9] = math.cos(math.pi / 4) - 1, math.sin(math.pi / 4)
    made = assemble_anchored(raw, torch.zeros(len(raw), 13), scene, config)
    axes = quaternion_to_matrix(scene.quats.flatten(0, 1))
    moved = torch.einsum("nji,nj->ni", axes, made.means - scene.means.flatten(0, 1))
    torch.testing.assert_close(moved[:, 1:], torch.zeros(len(moved), 2), rtol=0, atol=1e-4)
    moved = moved[:, 0].unflatten(0, (len(scene), -1))
    torch.testing.assert_close(moved, 2 * scene.spacing[:, None].expand_as(moved), rtol=1e-4, atol=1e-5)
    about_z = torch.tensor([math.cos(math.pi / 4), 0, 0, math.sin(math.pi / 4)]).expand(len(raw), 4)
    torch.testing.assert_close(made.quats, quaternion_product(scene.quats.flatten(0, 1), about_z))


def test_anchored_scales_stay_within_the_stated_factors_of_their_prior() -> None:
    """docs/method.md: between e⁻⁴ and e² times the prior, whatever the raw number."""
    config = compact()
    where = anchors(config)
    count = where.opacities.numel()
    appearance = torch.zeros(count, config.appearance_channels)
    for raw, factor in ((1e4, math.exp(2)), (-1e4, math.exp(-4)), (0.5, math.exp(0.5))):
        scales = assemble_anchored(torch.full((count, 10), raw), appearance, where, config).scales
        torch.testing.assert_close(scales, factor * where.scales.flatten(0, 1))
