"""The 3D smoothing filter: no Gaussian is thinner than the finest pixel that shows it."""

import math
from dataclasses import replace

import pytest
import torch

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.splat.render import RenderSettings, render
from querysplat_cli.splat.smoothing import SMOOTHING_POLICY, hold_above, sampling, smoothed

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
    after = smoothed(before, cameras)
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


def test_smoothing_twice_changes_nothing_more() -> None:
    cameras = cameras_at((0, 0, -1), (0.5, 0.2, 0.3))
    after = smoothed(scattered(300, 0), cameras)
    again = smoothed(after, cameras)
    assert torch.equal(again.scales, after.scales)
    torch.testing.assert_close(again.opacities, after.opacities)


def test_a_needle_becomes_thicker_and_keeps_its_length() -> None:
    pixel = 2 / FOCAL
    (after,) = smoothed(one(0.5, 1e-4, 1e-4), cameras_at((0, 0, 0))).scales
    wanted = math.sqrt(SMOOTHING_POLICY.variance) * pixel
    torch.testing.assert_close(after, torch.tensor([0.5, wanted, wanted]))


def test_the_nearest_photo_counts() -> None:
    far, near = cameras_at((0, 0, -8)), cameras_at((0, 0, 0))
    both = cameras_at((0, 0, -8), (0, 0, 0))
    means = torch.tensor([[0.0, 0, 2.0]])
    assert torch.equal(sampling(means, both).least, sampling(means, near).least)
    assert float(sampling(means, far).least) == pytest.approx(5 * float(sampling(means, near).least))


@pytest.mark.parametrize("scales", [(0.2, 1e-3, 1e-3), (0.2, 0.2, 1e-4), (2e-3, 2e-3, 2e-3), (0.1, 5e-3, 0.2)], ids=str)
def test_the_opacity_keeps_what_a_gaussian_adds_to_the_finest_photo(scales: tuple[float, float, float]) -> None:
    """The integral of alpha over a picture that is fine enough to show the Gaussian as it is."""
    before = one(*scales, opacity=0.9)
    after = smoothed(before, cameras_at((0, 0, 0)))
    assert float(after.scales.prod()) > float(before.scales.prod())
    microscope = cameras_at((0, 0, 0), focal=3000.0, size=1600)
    exact = RenderSettings(low_pass=0.0, alpha_min=1e-9)
    integrals = [
        float(render(some.to(torch.float64), microscope.to(torch.float64), settings=exact).alpha.sum())
        for some in (before, after)
    ]
    assert integrals[1] == pytest.approx(integrals[0], rel=0.02)


def test_a_disc_that_photos_show_from_the_front_stays_opaque() -> None:
    after = smoothed(one(0.2, 0.2, 1e-5, opacity=0.95), cameras_at((0, 0, 0)))
    assert float(after.opacities) == pytest.approx(0.95, rel=1e-3)


def test_a_gaussian_that_is_large_enough_stays_as_it_is() -> None:
    before = one(0.2, 0.1, 0.3)
    after = smoothed(before, cameras_at((0, 0, 0)))
    assert torch.equal(after.scales, before.scales)
    assert torch.equal(after.opacities, before.opacities)


def test_a_held_scale_can_still_grow_but_not_shrink() -> None:
    least = torch.tensor([1.0, 1.0])
    scales = torch.tensor([[0.5, 0.5, 2.0], [0.5, 0.5, 2.0]], requires_grad=True)
    held = hold_above(scales, least)
    torch.testing.assert_close(held.detach(), torch.tensor([[1.0, 1.0, 2.0]] * 2))
    held.backward(torch.tensor([[1.0, -1.0, 1.0], [0.0, -2.0, -1.0]]))
    torch.testing.assert_close(scales.grad, torch.tensor([[0.0, -1.0, 1.0], [0.0, -2.0, -1.0]]))


def test_gaussians_at_a_camera_have_no_bound_and_stay_finite() -> None:
    after = smoothed(replace(one(0.1, 1e-6, 1e-6), means=torch.zeros(1, 3)), cameras_at((0, 0, 0)))
    assert bool(after.scales.isfinite().all())
    assert bool(after.opacities.isfinite().all())
