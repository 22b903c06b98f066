"""Extreme and badly conditioned scenes. Numbers in brackets are rows of docs/stability.md."""

import math
from dataclasses import replace

import numba
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from splat_scenes import as_kernel_sees, assert_agree, outcome
from torch import Tensor

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.sim3 import Sim3
from querysplat_cli.splat import cpu
from querysplat_cli.splat.render import RenderSettings, render
from scenes import FIELDS, camera, cloud, single, stacked

BACKENDS = ("reference", "cpu")


def all_finite(gaussians: Gaussians, cameras: Cameras, backend: str) -> Tensor:
    """The colour, after checking that it and every gradient are finite."""
    found = outcome(gaussians, cameras, backend)
    for picture in (found.rendering.colour, found.rendering.alpha, found.rendering.depth):
        assert picture.isfinite().all()
    for name, gradient in found.gradients.items():
        assert gradient.isfinite().all(), name
    return found.rendering.colour


def assert_culled(gaussians: Gaussians, cameras: Cameras, backend: str) -> None:
    found = outcome(gaussians, cameras, backend)
    assert found.rendering.alpha.max() == 0
    for name, gradient in found.gradients.items():
        assert gradient.abs().max() == 0, name


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_quaternion_of_length_zero_is_culled_without_a_trace(backend: str) -> None:
    """[1, 40]"""
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
    """[1, 46] The slope by a quaternion is one over its length."""
    assert_culled(single(quats=[1e-40, 1e-41, 0, 0], scales=[0.5, 0.1, 0.02]), camera(16, 16), backend)


@pytest.mark.parametrize("length", [1e-20, 1e20])
@pytest.mark.parametrize("backend", BACKENDS)
def test_the_length_of_a_quaternion_does_not_matter(backend: str, length: float) -> None:
    """[1]"""
    unit = [0.5, -0.5, 0.1, 0.7]
    scene = single(quats=unit, scales=[0.5, 0.1, 0.02])
    scaled = single(quats=[length * q for q in unit], scales=[0.5, 0.1, 0.02])
    torch.testing.assert_close(
        all_finite(scaled, camera(16, 16), backend), all_finite(scene, camera(16, 16), backend), rtol=0, atol=1e-6
    )


@pytest.mark.parametrize("kappa", [1e2, 1e4, 1e8])
@pytest.mark.parametrize("turn", [0, 1, 2])
def test_needles(kappa: float, turn: int) -> None:
    """[2] Scales 1 : κ^-½ : 1/κ, across the view, along it, and askew."""
    quats = [[1.0, 0, 0, 0], [math.sqrt(0.5), 0, math.sqrt(0.5), 0], [0.8, 0.1, -0.3, 0.5]][turn]
    scene = single(quats=quats, scales=[1.0, kappa**-0.5, 1 / kappa])
    assert_agree(scene, camera(48, 48), gradient=2e-4, flips=0.005, depth=False)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_disc_seen_edge_on(backend: str) -> None:
    """[3]"""
    edge_on = single(quats=[math.sqrt(0.5), 0, math.sqrt(0.5), 0], scales=[0.5, 0.5, 1e-7])
    assert all_finite(edge_on, camera(24, 24), backend).max() > 0.01
    assert_agree(edge_on, camera(24, 24), depth=False)


def test_a_gaussian_that_covers_everything_and_one_that_covers_nothing() -> None:
    """[4]"""
    for scale in (1e3, 1e12):
        colour = all_finite(single(scales=[scale] * 3), camera(40, 40), "cpu")
        torch.testing.assert_close(
            colour[0, 0], torch.full((40, 40), 0.7 * (0.5 + 0.28209479 * 0.5)), rtol=0, atol=1e-5
        )
    speck = single(scales=[1e-12] * 3)
    assert_agree(speck, camera(15, 15))
    assert render(speck.to(torch.float32), camera(15, 15)).alpha.sum() < 2 * math.pi  # the low-pass dot and no more


@pytest.mark.parametrize("z", [0.0, 1e-7, 0.024999, -3.0, 125.1])
@pytest.mark.parametrize("backend", BACKENDS)
def test_what_is_behind_or_too_near_or_too_far_is_culled(backend: str, z: float) -> None:
    """[5]"""
    assert_culled(single(means=[0.0, 0, z]), camera(16, 16), backend)


@pytest.mark.parametrize("z", [0.025, 0.0250001, 124.9])
def test_what_is_just_inside_the_limits_is_seen(z: float) -> None:
    """[5]"""
    assert_agree(single(means=[0.0, 0, z], scales=[0.1 * z] * 3), camera(16, 16), depth=False)


@pytest.mark.parametrize("principal", [0.5, 0.1])
def test_far_off_axis_in_a_wide_view(principal: float) -> None:
    """[6, 41] The Jacobian stays inside the frustum widened by 0.3 half fields of view, cx and cy in account."""
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
    """[7, 36]"""
    scene = single(opacities=opacity)
    if opacity < 1 / 255:
        assert_culled(scene, camera(16, 16), backend)
    else:
        all_finite(scene, camera(16, 16), backend)
        alpha = render(scene, camera(16, 16), backend="reference").alpha
        assert 0 <= alpha.min() <= alpha.max() <= 0.99


@pytest.mark.parametrize("backend", BACKENDS)
def test_ten_thousand_opaque_gaussians_on_one_pixel(backend: str) -> None:
    """[8, 37]"""
    many = cloud(0, 10_000, camera(1, 1), opacity=(0.9, 1.0), pixels=1.0)
    all_finite(many, camera(1, 1), backend)
    assert render(many, camera(1, 1), backend=backend).alpha.max() <= 1


def test_ten_thousand_faint_gaussians_on_one_pixel() -> None:
    """[9] No colour is lost to rounding as the light fades by 10,000 steps."""
    many = cloud(0, 10_000, camera(1, 1), opacity=(1 / 254, 1 / 250), pixels=30.0)
    assert_agree(many, camera(1, 1), flips=1.0, gradient=5e-3)
    fast = render(many.to(torch.float32), camera(1, 1))
    exact = render(as_kernel_sees(many), camera(1, 1))
    assert float((fast.colour - exact.colour).abs().max()) < 1e-4


@pytest.mark.parametrize("backend", BACKENDS)
def test_equal_depths_keep_their_given_order(backend: str) -> None:
    """[10]"""
    red, blue = single(sh=[[1.0, -2, -2]], opacities=0.9), single(sh=[[-2.0, -2, 1]], opacities=0.9)
    for first, second, channel in ((red, blue, 0), (blue, red, 2)):
        colour = render(stacked(first, second), camera(9, 9), backend=backend).colour[0, :, 4, 4]
        assert int(colour.argmax()) == channel


@pytest.mark.parametrize("backend", BACKENDS)
def test_no_gaussians_and_none_in_view(backend: str) -> None:
    """[11]"""
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
    """[12]"""
    cameras = camera(height, width)
    assert_agree(cloud(height, 60, cameras, pixels=3.0), cameras, flips=0.002 if height > 1 else 0, gradient=1e-3)


@pytest.mark.parametrize("field_of_view", [1.0, 170.0])
def test_narrow_and_wide_views(field_of_view: float) -> None:
    """[13]"""
    cameras = camera(24, 32, field_of_view=field_of_view)
    assert_agree(cloud(2, 80, cameras), cameras, flips=0.003, gradient=1e-3)


def test_principal_point_outside_and_unequal_focal_lengths() -> None:
    """[13]"""
    cameras = camera(24, 32)
    cameras.K[:, 0, 2], cameras.K[:, 1, 1] = 40.0, 0.6 * float(cameras.K[0, 1, 1])
    assert_agree(cloud(2, 150, cameras), cameras, flips=0.003, gradient=1e-3)


def moved(scene: Gaussians, similarity: Sim3) -> Gaussians:
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
    """[15] With colours of degree 0, which do not turn with the world; near and far go along."""
    cameras = camera(24, 32, views=2)
    scene = cloud(4, 60, cameras, degree=0)
    rotation = torch.from_numpy(Rotation.random(random_state=2).as_matrix())
    similarity = Sim3(scale, rotation, torch.tensor([0.3, -0.2, 0.5], dtype=torch.float64) * scale)
    limits = RenderSettings(near=0.025 * scale, far=125 * scale)
    dtype = torch.float64 if backend == "reference" else torch.float32
    before = render(scene.to(dtype), cameras, backend=backend).colour
    after = render(moved(scene, similarity).to(dtype), cameras.transformed(similarity), backend=backend,
                   settings=limits).colour  # fmt: skip
    torch.testing.assert_close(after, before, rtol=0, atol=1e-9 if backend == "reference" else 2e-4)


def test_a_scene_far_from_the_origin_keeps_its_detail() -> None:
    """[14] A million units away, float32 centres are 1/16 apart: the error is the inputs' rounding, no more."""
    cameras = camera(24, 32)
    away = Sim3(1.0, torch.eye(3, dtype=torch.float64), torch.tensor([1e6, -1e6, 1e6], dtype=torch.float64))
    assert_agree(moved(cloud(4, 60, cameras), away), cameras.transformed(away), flips=0.005, gradient=1e-3)


@pytest.mark.parametrize("size", [-1e10, 1e10, 3e38])
@pytest.mark.parametrize("backend", BACKENDS)
def test_wild_colours(backend: str, size: float) -> None:
    """[16, 45] Clamped below as in 3DGS, and above where float32 would overflow."""
    scene = stacked(single(sh=[[size, 0.0, 0.0]]), single())
    colour = all_finite(scene, camera(16, 16), backend)
    assert colour.min() >= 0


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", FIELDS)
def test_nan_and_inf_are_refused_by_name_and_count(name: str, value: float) -> None:
    """[17]"""
    scene = cloud(0, 9, camera(8, 8)).to(torch.float32)
    getattr(scene, name)[3:5] = value
    count = getattr(scene, name)[3:5].numel()
    with pytest.raises(QuerySplatError, match=rf"^{count} of .*`{name}`"):
        render(scene, camera(8, 8))


@pytest.mark.parametrize("name", ["w2c", "K"])
def test_a_camera_that_is_not_a_number_is_refused(name: str) -> None:
    """[17]"""
    cameras = camera(8, 8)
    getattr(cameras, name)[0, 1, 1] = math.nan
    with pytest.raises(QuerySplatError, match=f"`{name}`"):
        render(single(), cameras)


def test_too_many_pairs_end_in_a_clear_message(monkeypatch: pytest.MonkeyPatch) -> None:
    """[18]"""
    monkeypatch.setattr(cpu, "PAIRS_LIMIT", 1000)
    with pytest.raises(QuerySplatError, match="fit in memory"):
        render(cloud(0, 50, camera(128, 128), pixels=50.0).to(torch.float32), camera(128, 128))


def test_a_cut_off_below_the_kernels_reach_is_refused() -> None:
    with pytest.raises(QuerySplatError, match="alpha"):
        render(single().to(torch.float32), camera(8, 8), settings=RenderSettings(alpha_min=1e-4))


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="needs two threads")
def test_one_thread_and_two_paint_the_same_bits() -> None:
    """[19] Pictures for any number of threads; gradients for the same number."""
    cameras = camera(70, 90, views=2)
    scene = cloud(1, 300, cameras)
    both = [outcome(scene, cameras, "cpu") for _ in range(2)]
    numba.set_num_threads(1)
    try:
        one = outcome(scene, cameras, "cpu")
    finally:
        numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)
    assert torch.equal(both[0].rendering.colour, one.rendering.colour)
    assert torch.equal(both[0].rendering.depth, one.rendering.depth)
    for name in FIELDS:
        assert torch.equal(both[0].gradients[name], both[1].gradients[name]), name
        torch.testing.assert_close(one.gradients[name], both[0].gradients[name], rtol=1e-4, atol=1e-5)


def test_an_order_flip_moves_the_picture_no_more_than_the_swap_allows() -> None:
    """[20] Two Gaussians that change places in depth swap colours by at most α₁·α₂ each."""
    near, far = single(sh=[[1.0, -2, -2]]), single(means=[0.0, 0, 3 + 1e-6], sh=[[-2.0, -2, 1]])
    before = render(stacked(near, far), camera(16, 16))
    after = render(stacked(replace(near, means=far.means), replace(far, means=near.means)), camera(16, 16))
    alpha = render(single(), camera(16, 16)).alpha
    assert ((before.colour - after.colour).abs() <= alpha[:, None] ** 2 + 1e-4).all()


@pytest.mark.parametrize("backend", BACKENDS)
def test_sizes_without_bounds(backend: str) -> None:
    """[39] e⁴⁰ is drawn; what overflows when squared in float32 (e⁴⁵), zero, and e⁸⁸ are culled."""
    assert all_finite(single(scales=[math.exp(40)] * 3), camera(8, 8), backend).max() > 0.1
    for wrong in ([math.exp(45)] * 3, [0.3, 0.0, 0.3], [3e38, 0.1, 0.1], [-0.1, 0.1, 0.1]):
        assert_culled(single(scales=wrong), camera(8, 8), backend)


def test_buffers_are_written_before_they_are_read(monkeypatch: pytest.MonkeyPatch) -> None:
    """[42] Every fresh buffer is filled with NaN: the result does not change."""
    cameras = camera(33, 50, views=2)
    scene = cloud(6, 120, cameras)
    expected = outcome(scene, cameras, "cpu")
    fresh = np.empty

    def poisoned(*arguments: object, **options: object) -> np.ndarray:
        array = fresh(*arguments, **options)  # type: ignore[call-overload]
        array[...] = np.nan if array.dtype.kind == "f" else -(2**30)
        return array

    monkeypatch.setattr(np, "empty", poisoned)
    found = outcome(scene, cameras, "cpu")
    assert torch.equal(found.rendering.colour, expected.rendering.colour)
    for name in FIELDS:
        assert torch.equal(found.gradients[name], expected.gradients[name]), name


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_inputs_are_blended_in_float32(dtype: torch.dtype) -> None:
    """[45]"""
    cameras = camera(16, 16)
    scene = cloud(2, 40, cameras).to(dtype)
    found = render(scene, cameras)
    assert found.colour.dtype == torch.float32
    assert torch.equal(found.colour, render(scene.to(torch.float32), cameras).colour)


POISON = (0.0, -0.0, 1e-45, -1e-45, 1e-38, -1e-38, 1e-20, -1e-20, 1e20, -1e20, 3.4e38, -3.4e38, 1.0, -1.0)


@settings(max_examples=60)
@given(
    name=st.sampled_from(FIELDS),
    values=st.lists(st.sampled_from(POISON), min_size=4, max_size=4),
    backend=st.sampled_from(BACKENDS),
)
def test_poison_in_one_gaussian_stays_there(name: str, values: list[float], backend: str) -> None:
    """[46] Extreme but finite numbers in any field: everything stays finite."""
    cameras = camera(12, 12)
    scene = as_kernel_sees(cloud(7, 12, cameras, degree=0))
    row = getattr(scene, name)[5]
    row.copy_(torch.tensor(values, dtype=torch.float64)[: max(1, row.numel())].reshape(row.shape))
    all_finite(scene, cameras, backend)
