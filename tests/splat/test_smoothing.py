"""The 3D smoothing filter: no Gaussian is thinner than the finest pixel that shows it."""

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.splat.smoothing import SMOOTHING_POLICY, bounded, convolved, held, least_scales

FOCAL, SIZE = 60.0, 64


def cameras_at(*centres: tuple[float, float, float], focal: float = FOCAL, size: int = SIZE) -> Cameras:
    """Cameras that look along +z."""
    w2c = torch.eye(4).repeat(len(centres), 1, 1)
    w2c[:, :3, 3] = -torch.tensor(centres)
    K = torch.tensor([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1.0]]).repeat(len(centres), 1, 1)
    return Cameras(w2c, K, size, size)


def one(*scales: float, opacity: float = 0.5, at: tuple[float, float, float] = (0, 0, 2.0)) -> Gaussians:
    return Gaussians(
        torch.tensor([at]),
        torch.tensor([[1.0, 0, 0, 0]]),
        torch.tensor([scales]),
        torch.tensor([opacity]),
        torch.ones(1, 1, 3),
    )


def scattered(count: int, seed: int) -> Gaussians:
    """Gaussians all around, also beside and behind the cameras, some of them needles and some discs."""
    random = torch.Generator().manual_seed(seed)
    return Gaussians(
        6 * torch.rand(count, 3, generator=random) - torch.tensor([3.0, 3.0, 1.0]),
        torch.randn(count, 4, generator=random),
        10 ** (5 * torch.rand(count, 3, generator=random) - 5),
        torch.rand(count, generator=random),
        torch.randn(count, 4, 3, generator=random),
    )


@pytest.mark.parametrize("seed", range(5))
def test_no_gaussian_is_thinner_than_the_finest_photo_that_sees_it_can_show(seed: int) -> None:
    """The bound is computed here anew, one Gaussian and one camera at a time."""
    before = scattered(200, seed)
    cameras = cameras_at((0, 0, -1), (0.5, 0.2, 0.3), (-2, 0, -4))
    after = bounded(before, cameras)
    checked = 0
    for n, point in enumerate(before.means):
        pixels = []
        for centre in cameras.centres:
            x, y, z = (point - centre).tolist()
            edge = (0.5 + SMOOTHING_POLICY.margin) * SIZE / FOCAL
            if z > 0 and abs(x) <= edge * z and abs(y) <= edge * z:
                pixels.append(z / FOCAL)
        if not pixels:
            pixels = [float((point - centre).norm()) / FOCAL for centre in cameras.centres]
        else:
            checked += 1
        least = math.sqrt(SMOOTHING_POLICY.variance) * min(pixels)
        wanted = before.scales[n].clamp_min(least)
        torch.testing.assert_close(after.scales[n], wanted, rtol=1e-4, atol=0)
    assert 50 < checked < 200  # some are seen, and some are not
    assert bool((after.opacities <= before.opacities).all())
    assert bool((after.opacities >= 0).all())
    for name in ("means", "quats", "sh"):
        assert torch.equal(getattr(after, name), getattr(before, name))


def test_bounding_twice_changes_nothing_more() -> None:
    cameras = cameras_at((0, 0, -1), (0.5, 0.2, 0.3))
    after = bounded(scattered(300, 0), cameras)
    again = bounded(after, cameras)
    assert torch.equal(again.scales, after.scales)
    torch.testing.assert_close(again.opacities, after.opacities)


def test_a_needle_becomes_thicker_and_keeps_its_length() -> None:
    pixel = 2 / FOCAL
    (after,) = bounded(one(0.5, 1e-4, 1e-4), cameras_at((0, 0, 0))).scales
    wanted = math.sqrt(SMOOTHING_POLICY.variance) * pixel
    torch.testing.assert_close(after, torch.tensor([0.5, wanted, wanted]))


def test_the_nearest_photo_counts() -> None:
    far, near = cameras_at((0, 0, -8)), cameras_at((0, 0, 0))
    both = cameras_at((0, 0, -8), (0, 0, 0))
    means = torch.tensor([[0.0, 0, 2.0]])
    assert torch.equal(least_scales(means, both), least_scales(means, near))
    assert float(least_scales(means, far)) == pytest.approx(5 * float(least_scales(means, near)))


@pytest.mark.parametrize("smooth", [bounded, convolved])
@pytest.mark.parametrize("scales", [(0.2, 1e-3, 1e-3), (0.2, 0.2, 1e-4), (2e-3, 2e-3, 2e-3), (0.1, 5e-3, 0.2)], ids=str)
def test_the_opacity_keeps_the_integral_of_the_density(
    smooth: Callable[[Gaussians, Cameras], Gaussians], scales: tuple[float, float, float]
) -> None:
    before = one(*scales, opacity=0.9)
    after = smooth(before, cameras_at((0, 0, 0)))
    assert float(after.scales.prod()) > 1.01 * float(before.scales.prod())
    for some in (before, after):  # opacity·exp(−x²/2s²) over all of space, along one axis after the other
        whole = float(some.opacities)
        for scale in some.scales[0].double():
            x = torch.linspace(-8, 8, 4001).double() * scale
            whole *= float(torch.trapezoid((-0.5 * (x / scale).square()).exp(), x))
        assert whole == pytest.approx(0.9 * math.prod(scales) * (2 * math.pi) ** 1.5, rel=1e-4)


def test_the_filter_is_a_convolution() -> None:
    """Two filters, one after the other, are one whose variance is the sum."""
    some = scattered(100, 0)
    three, four, five = (cameras_at((0, 0, -1), focal=60 / least, size=64) for least in (0.03, 0.04, 0.05))
    torch.testing.assert_close(least_scales(some.means, three) * 5 / 3, least_scales(some.means, five))
    twice, once = convolved(convolved(some, three), four), convolved(some, five)
    torch.testing.assert_close(twice.scales, once.scales)
    torch.testing.assert_close(twice.opacities, once.opacities)


def test_what_went_through_the_filter_keeps_the_bound_exactly() -> None:
    cameras = cameras_at((0, 0, -1), (0.5, 0.2, 0.3), (-2, 0, -4))
    after = convolved(scattered(1000, 0), cameras)
    assert torch.equal(bounded(after, cameras).scales, after.scales)


def test_a_gaussian_that_is_large_enough_stays_as_it_is() -> None:
    before = one(0.2, 0.1, 0.3)
    after = bounded(before, cameras_at((0, 0, 0)))
    assert torch.equal(after.scales, before.scales)
    assert torch.equal(after.opacities, before.opacities)


def test_a_held_scale_can_come_back_but_go_no_farther() -> None:
    least, largest = torch.tensor([1.0, 1.0]), torch.tensor([3.0, 0.5])
    scales = torch.tensor([[0.5, 2.0, 4.0], [0.5, 2.0, 4.0]], requires_grad=True)
    within = held(scales, least, largest)
    # Where the bounds contradict each other, the lower one holds.
    torch.testing.assert_close(within.detach(), torch.tensor([[1.0, 2.0, 3.0], [1.0, 1.0, 1.0]]))
    (smaller,) = torch.autograd.grad(within, scales, torch.ones_like(scales), retain_graph=True)
    (larger,) = torch.autograd.grad(within, scales, -torch.ones_like(scales))
    torch.testing.assert_close(smaller, torch.tensor([[0.0, 1.0, 1.0], [0.0, 1.0, 1.0]]))
    torch.testing.assert_close(larger, -torch.tensor([[1.0, 1.0, 0.0], [1.0, 0.0, 0.0]]))


def test_gaussians_at_a_camera_have_no_bound_and_stay_finite() -> None:
    after = bounded(replace(one(0.1, 1e-6, 1e-6), means=torch.zeros(1, 3)), cameras_at((0, 0, 0)))
    assert bool(after.scales.isfinite().all())
    assert bool(after.opacities.isfinite().all())
