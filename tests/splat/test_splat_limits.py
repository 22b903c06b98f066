"""Extreme numbers, refusals, memory and threads. Rows are those of docs/reference/stability-cases.md."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numba
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from splat_scenes import BACKENDS, all_finite, as_kernel_sees, assert_culled, outcome

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.splat import cpu
from querysplat_cli.splat.render import RenderSettings, render
from scenes import FIELDS, camera, cloud, single, stacked


@pytest.mark.parametrize("size", [-1e10, 1e10, 3e38])
@pytest.mark.parametrize("backend", BACKENDS)
def test_wild_colours(backend: str, size: float) -> None:
    """Rows 16 and 45: colours are clamped at 0 as in 3DGS, and above where float32 would overflow."""
    scene = stacked(single(sh=[[size, 0.0, 0.0]]), single())
    colour = all_finite(scene, camera(16, 16), backend)
    assert colour.min() >= 0


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", FIELDS)
def test_nan_and_inf_are_refused_by_name_and_count(name: str, value: float) -> None:
    """Row 17: the message has the tensor's name and the count of its bad numbers."""
    scene = cloud(0, 9, camera(8, 8)).to(torch.float32)
    getattr(scene, name)[3:5] = value
    count = getattr(scene, name)[3:5].numel()
    with pytest.raises(QuerySplatError, match=rf"^{count} of .*`{name}`"):
        render(scene, camera(8, 8))


@pytest.mark.parametrize("name", ["w2c", "K"])
def test_a_camera_that_is_not_a_number_is_refused(name: str) -> None:
    """Row 17: the message has the matrix's name."""
    cameras = camera(8, 8)
    getattr(cameras, name)[0, 1, 1] = math.nan
    with pytest.raises(QuerySplatError, match=f"`{name}`"):
        render(single(), cameras)


def test_too_many_pairs_end_in_a_clear_message(monkeypatch: pytest.MonkeyPatch) -> None:
    """Row 18: instead of a list that does not fit in memory."""
    monkeypatch.setattr(cpu, "PAIRS_LIMIT", 1000)
    with pytest.raises(QuerySplatError, match="fit in memory"):
        render(cloud(0, 50, camera(128, 128), pixels=50.0).to(torch.float32), camera(128, 128))


def test_a_cut_off_below_that_of_the_kernel_is_refused() -> None:
    with pytest.raises(QuerySplatError, match="alpha"):
        render(single().to(torch.float32), camera(8, 8), settings=RenderSettings(alpha_min=1e-4))


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="needs two threads")
def test_one_thread_and_two_render_the_same_bits() -> None:
    """Row 19: pictures have the same bits for any number of threads, gradients for the same number."""
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
    """Row 20: when two Gaussians change places in depth, a pixel changes by at most α₁·α₂ of each colour."""
    near, far = single(sh=[[1.0, -2, -2]]), single(means=[0.0, 0, 3 + 1e-6], sh=[[-2.0, -2, 1]])
    before = render(stacked(near, far), camera(16, 16))
    after = render(stacked(replace(near, means=far.means), replace(far, means=near.means)), camera(16, 16))
    alpha = render(single(), camera(16, 16)).alpha
    assert ((before.colour - after.colour).abs() <= alpha[:, None] ** 2 + 1e-4).all()


@pytest.mark.parametrize("backend", BACKENDS)
def test_sizes_without_bounds(backend: str) -> None:
    """Row 39: e⁴⁰ is drawn; what leaves float32's range when squared (1e18, e⁴⁵), zero, and 3e38 are culled."""
    assert all_finite(single(scales=[math.exp(40)] * 3), camera(8, 8), backend).max() > 0.1
    for wrong in ([1e18] * 3, [math.exp(45)] * 3, [0.3, 0.0, 0.3], [3e38, 0.1, 0.1], [-0.1, 0.1, 0.1]):
        assert_culled(single(scales=wrong), camera(8, 8), backend)


def test_buffers_are_written_before_they_are_read(monkeypatch: pytest.MonkeyPatch) -> None:
    """Row 42: every new buffer is filled with NaN, and the result does not change."""
    cameras = camera(33, 50, views=2)
    scene = cloud(6, 120, cameras)
    expected = outcome(scene, cameras, "cpu")

    def filled_with_nan(make: Callable[..., np.ndarray], *arguments: object, **options: object) -> np.ndarray:
        array = make(*arguments, **options)
        array[...] = np.nan if array.dtype.kind == "f" else -(2**30)
        return array

    for name in ("empty", "empty_like"):
        monkeypatch.setattr(np, name, partial(filled_with_nan, getattr(np, name)))
    found = outcome(scene, cameras, "cpu")
    assert torch.equal(found.rendering.colour, expected.rendering.colour)
    for name in FIELDS:
        assert torch.equal(found.gradients[name], expected.gradients[name]), name


def test_what_a_picture_brought_stays_when_the_next_one_is_drawn() -> None:
    """The working memory of the backward pass is used again."""
    cameras = camera(33, 50, views=2)
    target = torch.ones(4, 33, 50)
    drawn = cpu.Drawn.of(cloud(6, 120, cameras), cameras[[0]], RenderSettings())
    slopes, weights = drawn.pull_back(target)
    gradients = outcome(cloud(6, 120, cameras), cameras, "cpu").gradients
    kept = [tensor.clone() for tensor in (*slopes.tensors(), weights, *gradients.values())]
    outcome(cloud(7, 240, cameras), cameras, "cpu")
    now = (*slopes.tensors(), weights, *gradients.values())
    assert all(torch.equal(before, after) for before, after in zip(kept, now, strict=True))


def test_no_view_sends_no_gradient() -> None:
    cameras = camera(8, 8)
    scene = outcome(cloud(6, 120, cameras), cameras[[]], "cpu")
    assert scene.rendering.colour.shape == (0, 3, 8, 8)
    assert all((scene.gradients[name] == 0).all() for name in FIELDS)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_inputs_are_blended_in_float32(dtype: torch.dtype) -> None:
    """Row 45: float16 and bfloat16 are converted to float32 first."""
    cameras = camera(16, 16)
    scene = cloud(2, 40, cameras).to(dtype)
    found = render(scene, cameras)
    assert found.colour.dtype == torch.float32
    assert torch.equal(found.colour, render(scene.to(torch.float32), cameras).colour)


EXTREMES = (0.0, -0.0, 1e-45, -1e-45, 1e-38, -1e-38, 1e-20, -1e-20, 1e20, -1e20, 3.4e38, -3.4e38, 1.0, -1.0)


@settings(max_examples=60)
@given(
    name=st.sampled_from(FIELDS),
    values=st.lists(st.sampled_from(EXTREMES), min_size=4, max_size=4),
    backend=st.sampled_from(BACKENDS),
)
def test_extreme_numbers_in_one_gaussian_stay_finite(name: str, values: list[float], backend: str) -> None:
    """Row 46: with extreme but finite numbers in any field, pictures and gradients stay finite."""
    cameras = camera(12, 12)
    scene = as_kernel_sees(cloud(7, 12, cameras, degree=0))
    row = getattr(scene, name)[5]
    row.copy_(torch.tensor(values, dtype=torch.float64)[: max(1, row.numel())].reshape(row.shape))
    all_finite(scene, cameras, backend)
