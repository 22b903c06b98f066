"""PSNR and SSIM against scikit-image and closed forms; the compiled loss against plain torch."""

import math

import pytest
import torch
from skimage.metrics import structural_similarity

from querysplat_cli.splat.similarity import RADIUS, photometric_loss, psnr, ssim_map, ssim_metric, taps


def pictures(seed: int, *shape: int, dtype: torch.dtype = torch.float32) -> tuple[torch.Tensor, torch.Tensor]:
    """A random picture and a noisy copy, with values a little outside [0, 1] as renders have."""
    generator = torch.Generator().manual_seed(seed)
    target = torch.rand(*shape, generator=generator, dtype=torch.float64)
    image = target + 0.2 * torch.randn(*shape, generator=generator, dtype=torch.float64)
    return image.to(dtype), target.to(dtype)


def reference(
    image: torch.Tensor, target: torch.Tensor, mask: torch.Tensor, ssim_weight: float
) -> tuple[float, torch.Tensor]:
    """Loss and gradient in float64 by plain torch."""
    leaf = image.double().requires_grad_()
    loss = photometric_loss(leaf, target.double(), mask, ssim_weight)
    return float(loss.detach()), torch.autograd.grad(loss, leaf)[0]


def test_psnr_of_a_known_error_and_mask() -> None:
    image, target = torch.full((3, 4, 5), 0.6), torch.full((3, 4, 5), 0.5)
    assert psnr(image, target) == pytest.approx(20.0, abs=1e-4)
    image[:, 0] = 0.5
    mask = torch.ones(4, 5, dtype=torch.bool)
    mask[0] = False
    assert psnr(image, target, mask) == pytest.approx(20.0, abs=1e-4)
    assert psnr(image, target) == pytest.approx(20.0 - 10 * math.log10(0.75), abs=1e-4)
    assert psnr(target, target) == math.inf


def test_taps_are_the_specified_ones() -> None:
    expected = [0.00102838, 0.00759876, 0.03600077, 0.10936069, 0.21300553, 0.26601172]
    torch.testing.assert_close(
        torch.from_numpy(taps()[:6]), torch.tensor(expected, dtype=torch.float64), rtol=0, atol=1e-8
    )
    assert taps().sum() == pytest.approx(1, abs=1e-15)


@pytest.mark.parametrize("shape", [(3, 40, 56), (3, 11, 11), (3, 13, 200)])
def test_metric_is_scikit_images(shape: tuple[int, ...]) -> None:
    image, target = pictures(0, *shape)
    options = {"gaussian_weights": True, "data_range": 1, "channel_axis": 0, "win_size": 11}
    theirs = structural_similarity(image.double().numpy(), target.double().numpy(), **options)
    assert ssim_metric(image, target) == pytest.approx(theirs, abs=1e-10)


@pytest.mark.parametrize("shape", [(1, 3, 24, 33), (4, 3, 17, 12), (1, 3, 3, 40), (2, 3, 1, 1), (1, 3, 11, 5)])
@pytest.mark.parametrize(("share", "ssim_weight"), [(1.0, 0.2), (0.6, 0.2), (0.6, 0.4), (0.0, 0.2)])
def test_compiled_loss_and_gradient_are_plain_torchs(shape: tuple[int, ...], share: float, ssim_weight: float) -> None:
    """Pictures smaller than the window included (row 30 of docs/reference/stability-cases.md)."""
    image, target = pictures(1, *shape)
    mask = torch.rand(shape[0], *shape[2:], generator=torch.Generator().manual_seed(2)) < share
    leaf = image.clone().requires_grad_()
    loss = photometric_loss(leaf, target, mask, ssim_weight)
    (slope,) = torch.autograd.grad(3 * loss, leaf)
    exact, exact_slope = reference(image, target, mask, ssim_weight)
    assert float(loss.detach()) == pytest.approx(exact, abs=2e-7)
    size = float(exact_slope.abs().max())
    assert float((slope / 3 - exact_slope).abs().max()) <= 5e-6 * max(size, 1e-12)  # 1.3e-6 seen


def test_plain_torchs_gradient_is_finite_differences() -> None:
    image, target = pictures(3, 1, 3, 3, 4, dtype=torch.float64)
    mask = torch.rand(1, 3, 4, generator=torch.Generator().manual_seed(4)) < 0.7
    assert torch.autograd.gradcheck(lambda a: photometric_loss(a, target, mask), image.requires_grad_())


def test_views_count_alike_whatever_their_masks() -> None:
    image, target = pictures(5, 2, 3, 20, 20)
    mask = torch.ones(2, 20, 20, dtype=torch.bool)
    mask[1, 3:] = False
    both = photometric_loss(image, target, mask)
    each = [photometric_loss(image[[i]], target[[i]], mask[[i]]) for i in range(2)]
    assert float(both) == pytest.approx(float(sum(each)) / 2, rel=1e-6)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_masked_border_is_no_part_of_the_picture(dtype: torch.dtype) -> None:
    """Photos lie in the corner of a canvas: what a render shows beyond was compared with black in SSIM's windows."""
    image, target = pictures(9, 1, 3, 40, 50, dtype=dtype)
    mask = torch.zeros(1, 40, 50, dtype=torch.bool)
    mask[:, :33, :41] = True
    whole, cut = image.requires_grad_(), image.detach()[..., :33, :41].requires_grad_()
    loss, same = photometric_loss(whole, target, mask), photometric_loss(cut, target[..., :33, :41])
    assert float(loss.detach()) == pytest.approx(float(same.detach()), rel=1e-6)
    (slope,), (expected,) = torch.autograd.grad(loss, whole), torch.autograd.grad(same, cut)
    torch.testing.assert_close(slope[..., :33, :41], expected, rtol=1e-5, atol=1e-9)
    assert not slope[:, :, 33:].any()
    assert not slope[..., 41:].any()


def test_no_mask_is_everything_and_the_target_gets_no_gradient() -> None:
    image, target = pictures(6, 2, 3, 16, 16)
    target.requires_grad_()
    loss = photometric_loss(image.requires_grad_(), target)
    assert torch.equal(loss, photometric_loss(image, target, torch.ones(2, 16, 16, dtype=torch.bool)))
    loss.backward()
    assert target.grad is None
    double = target.detach().double().requires_grad_()
    photometric_loss(image.detach().double().requires_grad_(), double).backward()
    assert double.grad is None


@pytest.mark.parametrize("level", [0.0, 0.4, 1.0])
def test_constant_and_identical_pictures(level: float) -> None:
    """Row 30 of docs/reference/stability-cases.md: SSIM of constant pictures is its closed form."""
    flat = torch.full((1, 3, 30, 30), level)
    other = torch.full((1, 3, 30, 30), 0.2)
    inside = (..., slice(RADIUS, -RADIUS), slice(RADIUS, -RADIUS))
    expected = (2 * level * 0.2 + 1e-4) / (level**2 + 0.04 + 1e-4)
    torch.testing.assert_close(
        ssim_map(flat, other)[inside], torch.full((1, 3, 20, 20), expected), rtol=1e-3, atol=1e-3
    )
    for a, b in ((flat, other), (flat, flat), pictures(7, 1, 3, 30, 30)[:1] * 2):
        leaf = a.clone().requires_grad_()
        loss = photometric_loss(leaf, b)
        (slope,) = torch.autograd.grad(loss, leaf)
        assert loss.isfinite()
        assert slope.isfinite().all()
        if a is b:
            assert float(loss.detach()) == pytest.approx(0, abs=1e-7)
            assert float(slope.abs().max()) < 1e-7


def test_the_loss_repeats_bit_for_bit() -> None:
    image, target = pictures(8, 3, 3, 40, 50)
    results = []
    for _ in range(2):
        leaf = image.clone().requires_grad_()
        loss = photometric_loss(leaf, target)
        results.append((loss.detach(), torch.autograd.grad(loss, leaf)[0]))
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


@pytest.mark.parametrize("share", [1.0, 0.5, 0.1])
def test_only_masked_pixels_count_in_the_reported_ssim(share: float) -> None:
    """Noise against noise; where all pixels counted, nine masked tenths gave 0.9."""
    noise = torch.rand(2, 3, 80, 80, generator=torch.Generator().manual_seed(0))
    mask = torch.zeros(80, 80, dtype=torch.bool)
    mask[:, : round(80 * share)] = True
    assert abs(ssim_metric(noise[0], noise[1], mask)) < 0.4
    outside = torch.where(mask, noise[0], torch.zeros(()))
    assert ssim_metric(outside, noise[1], mask) == ssim_metric(noise[0], noise[1], mask)
