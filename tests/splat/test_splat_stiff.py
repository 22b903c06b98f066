"""Badly conditioned scenes: shapes, places and cameras. Rows are those of docs/reference/stability-cases.md."""

import math
from dataclasses import replace

import pytest
import torch
from scipy.spatial.transform import Rotation
from splat_scenes import BACKENDS, all_finite, as_kernel_sees, assert_agree, assert_culled, outcome

from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.sim3 import Sim3
from querysplat_cli.splat.render import RenderSettings, render
from scenes import FIELDS, camera, cloud, single, stacked


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_quaternion_of_length_zero_is_culled(backend: str) -> None:
    """Rows 1 and 40: such a Gaussian changes neither the picture nor the gradients of others."""
    assert_culled(single(quats=[0.0, 0, 0, 0]), camera(16, 16), backend)
    sound = cloud(0, 30, camera(16, 16))
    with_zero = stacked(sound, single(quats=[0.0, 0, 0, 0], sh=[[0.0] * 3] * 4))
    alone, together = outcome(sound, camera(16, 16), backend), outcome(with_zero, camera(16, 16), backend)
    assert torch.equal(alone.rendering.colour, together.rendering.colour)
    for name in FIELDS:
        assert torch.equal(alone.gradients[name], together.gradients[name][:-1]), name
        assert together.gradients[name][-1].abs().max() == 0, name


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_quaternion_too_short_for_a_gradient_is_culled(backend: str) -> None:
    """Rows 1 and 46: the gradient with respect to a quaternion grows as one over its length."""
    assert_culled(single(quats=[1e-40, 1e-41, 0, 0], scales=[0.5, 0.1, 0.02]), camera(16, 16), backend)


@pytest.mark.parametrize("length", [1e-20, 1e20])
@pytest.mark.parametrize("backend", BACKENDS)
def test_the_length_of_a_quaternion_does_not_matter(backend: str, length: float) -> None:
    """Row 1: only the direction of a quaternion matters."""
    unit = [0.5, -0.5, 0.1, 0.7]
    scene = single(quats=unit, scales=[0.5, 0.1, 0.02])
    scaled = single(quats=[length * q for q in unit], scales=[0.5, 0.1, 0.02])
    torch.testing.assert_close(
        all_finite(scaled, camera(16, 16), backend), all_finite(scene, camera(16, 16), backend), rtol=0, atol=1e-6
    )


@pytest.mark.parametrize("kappa", [1e2, 1e4, 1e8])
@pytest.mark.parametrize("turn", [0, 1, 2])
def test_needles(kappa: float, turn: int) -> None:
    """Row 2: scales 1 : κ^-½ : 1/κ, across the view, along it, and askew."""
    quats = [[1.0, 0, 0, 0], [math.sqrt(0.5), 0, math.sqrt(0.5), 0], [0.8, 0.1, -0.3, 0.5]][turn]
    scene = single(quats=quats, scales=[1.0, kappa**-0.5, 1 / kappa])
    assert_agree(scene, camera(48, 48), gradient=2e-4, flips=0.005, depth=False)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_disc_seen_edge_on(backend: str) -> None:
    """Row 3: its covariance in the picture is singular but for the low-pass filter."""
    edge_on = single(quats=[math.sqrt(0.5), 0, math.sqrt(0.5), 0], scales=[0.5, 0.5, 1e-7])
    assert all_finite(edge_on, camera(24, 24), backend).max() > 0.01
    assert_agree(edge_on, camera(24, 24), depth=False)


def test_a_gaussian_that_covers_everything_and_one_that_covers_nothing() -> None:
    """Row 4: a scale far larger than the picture, and one far smaller than a pixel."""
    for scale in (1e3, 1e12):
        colour = all_finite(single(scales=[scale] * 3), camera(40, 40), "cpu")
        torch.testing.assert_close(
            colour[0, 0], torch.full((40, 40), 0.7 * (0.5 + 0.28209479 * 0.5)), rtol=0, atol=1e-5
        )
    speck = single(scales=[1e-12] * 3)
    assert_agree(speck, camera(15, 15))
    assert render(speck.to(torch.float32), camera(15, 15)).alpha.sum() < 2 * math.pi  # the low-pass dot and no more


@pytest.mark.parametrize("z", [0.0, 1e-7, 0.024999, -3.0, 1.001 * RenderSettings.far])
@pytest.mark.parametrize("backend", BACKENDS)
def test_what_is_behind_or_too_near_or_too_far_is_culled(backend: str, z: float) -> None:
    """Row 5: nothing is drawn and no gradient passes."""
    assert_culled(single(means=[0.0, 0, z]), camera(16, 16), backend)


@pytest.mark.parametrize("z", [0.025, 0.0250001, 124.9, 0.999 * RenderSettings.far])
def test_what_is_just_inside_the_limits_is_seen(z: float) -> None:
    """Row 5: what is drawn agrees with the reference."""
    assert_agree(single(means=[0.0, 0, z], scales=[0.1 * z] * 3), camera(16, 16), depth=False)


@pytest.mark.parametrize("principal", [0.5, 0.1])
def test_far_off_axis_in_a_wide_view(principal: float) -> None:
    """Rows 6 and 41: the Jacobian stays inside the frustum widened by 0.3 half fields of view, whatever cx and cy."""
    cameras = camera(32, 32, field_of_view=120)
    cameras.K[:, 0, 2] = principal * 32
    scene = cloud(3, 60, cameras, pixels=4.0)
    scene.means[:, :2] *= 2.5
    assert_agree(scene, cameras, flips=0.005, gradient=1e-3)
    for backend in BACKENDS:
        all_finite(single(means=[80.0, 3.0, 0.03], scales=[9.0, 9.0, 9.0]), cameras, backend)


@pytest.mark.parametrize("opacity", [0.0, 1 / 256, 1 / 255, 1 - 1e-9, 1.0])
@pytest.mark.parametrize("backend", BACKENDS)
def test_opacities_at_their_ends(backend: str, opacity: float) -> None:
    """Rows 7 and 36: below 1/255 a Gaussian is culled; alpha never exceeds its cap of 0.99."""
    scene = single(opacities=opacity)
    if opacity < 1 / 255:
        assert_culled(scene, camera(16, 16), backend)
    else:
        all_finite(scene, camera(16, 16), backend)
        alpha = render(scene, camera(16, 16), backend="reference").alpha
        assert 0 <= alpha.min() <= alpha.max() <= 0.99


@pytest.mark.parametrize("backend", BACKENDS)
def test_ten_thousand_opaque_gaussians_on_one_pixel(backend: str) -> None:
    """Rows 8 and 37: transmittance ends near zero, and the backward pass divides by no zero."""
    many = cloud(0, 10_000, camera(1, 1), opacity=(0.9, 1.0), pixels=1.0)
    all_finite(many, camera(1, 1), backend)
    assert render(many, camera(1, 1), backend=backend).alpha.max() <= 1


def test_ten_thousand_faint_gaussians_on_one_pixel() -> None:
    """Row 9: no colour is lost to rounding while transmittance falls in 10,000 small steps."""
    many = cloud(0, 10_000, camera(1, 1), opacity=(1 / 254, 1 / 250), pixels=30.0)
    assert_agree(many, camera(1, 1), flips=1.0, gradient=5e-3)
    fast = render(many.to(torch.float32), camera(1, 1))
    exact = render(as_kernel_sees(many), camera(1, 1))
    assert float((fast.colour - exact.colour).abs().max()) < 1e-4


@pytest.mark.parametrize("backend", BACKENDS)
def test_equal_depths_keep_their_given_order(backend: str) -> None:
    """Row 10: the first of two equal depths is in front."""
    red, blue = single(sh=[[1.0, -2, -2]], opacities=0.9), single(sh=[[-2.0, -2, 1]], opacities=0.9)
    for first, second, channel in ((red, blue, 0), (blue, red, 2)):
        colour = render(stacked(first, second), camera(9, 9), backend=backend).colour[0, :, 4, 4]
        assert int(colour.argmax()) == channel


@pytest.mark.parametrize("backend", BACKENDS)
def test_no_gaussians_and_none_in_view(backend: str) -> None:
    """Row 11: the picture is the background, and every gradient is finite."""
    background = torch.tensor([0.25, 0.5, 0.75])
    nothing = cloud(0, 0, camera(8, 8))
    for scene in (nothing, single(means=[0.0, 50.0, 3.0]), single(means=[0.0, 0, -3.0])):
        found = render(scene, camera(8, 8), backend=backend, background=background)
        assert torch.equal(found.colour, background.to(found.colour)[:, None, None].expand(1, 3, 8, 8))
        all_finite(scene, camera(8, 8), backend)


@pytest.mark.parametrize("backend", BACKENDS)
def test_no_views(backend: str) -> None:
    assert render(single(), camera(8, 8)[:0], backend=backend).colour.shape == (0, 3, 8, 8)


@pytest.mark.parametrize(("height", "width"), [(1, 1), (17, 33), (16, 16), (15, 1), (2, 1024)])
def test_pictures_of_odd_sizes(height: int, width: int) -> None:
    """Row 12: one pixel, tiles cut by the border, one column, two rows."""
    cameras = camera(height, width)
    assert_agree(cloud(height, 60, cameras, pixels=3.0), cameras, flips=0.002 if height > 1 else 0, gradient=1e-3)


@pytest.mark.parametrize("field_of_view", [1.0, 170.0])
def test_narrow_and_wide_views(field_of_view: float) -> None:
    """Row 13: fields of view of 1° and 170°."""
    cameras = camera(24, 32, field_of_view=field_of_view)
    assert_agree(cloud(2, 80, cameras), cameras, flips=0.003, gradient=1e-3)


def test_principal_point_outside_and_unequal_focal_lengths() -> None:
    """Row 13: cx lies outside the picture, and fy is 0.6 of fx."""
    cameras = camera(24, 32)
    cameras.K[:, 0, 2], cameras.K[:, 1, 1] = 40.0, 0.6 * float(cameras.K[0, 1, 1])
    assert_agree(cloud(2, 150, cameras), cameras, flips=0.003, gradient=1e-3)


def transformed(scene: Gaussians, similarity: Sim3) -> Gaussians:
    turn = Rotation.from_matrix(similarity.rotation.numpy())
    quats = Rotation.from_quat(scene.quats.numpy(), scalar_first=True)
    return replace(
        scene,
        means=similarity.apply(scene.means),
        quats=torch.from_numpy((turn * quats).as_quat(scalar_first=True)),
        scales=scene.scales * similarity.scale,
    )


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("backend", BACKENDS)
def test_a_similarity_of_the_world_leaves_the_picture_alone(backend: str, scale: float) -> None:
    """Row 15: with colours of degree 0, which do not depend on direction; near and far are scaled, too."""
    cameras = camera(24, 32, views=2)
    scene = cloud(4, 60, cameras, degree=0)
    rotation = torch.from_numpy(Rotation.random(random_state=2).as_matrix())
    similarity = Sim3(scale, rotation, torch.tensor([0.3, -0.2, 0.5], dtype=torch.float64) * scale)
    limits = RenderSettings(near=0.025 * scale, far=125 * scale)
    dtype = torch.float64 if backend == "reference" else torch.float32
    before = render(scene.to(dtype), cameras, backend=backend).colour
    after = render(transformed(scene, similarity).to(dtype), cameras.transformed(similarity), backend=backend,
                   settings=limits).colour  # fmt: skip
    torch.testing.assert_close(after, before, rtol=0, atol=1e-9 if backend == "reference" else 2e-4)


def test_a_scene_far_from_the_origin_keeps_its_detail() -> None:
    """Row 14: a million units away, float32 centres are 1/16 apart. The error is only that rounding of the inputs."""
    cameras = camera(24, 32)
    away = Sim3(1.0, torch.eye(3, dtype=torch.float64), torch.tensor([1e6, -1e6, 1e6], dtype=torch.float64))
    assert_agree(transformed(cloud(4, 60, cameras), away), cameras.transformed(away), flips=0.005, gradient=1e-3)
