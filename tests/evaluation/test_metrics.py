"""Metrics against scikit-image, against closed forms, and against the stored figures."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from querysplat_cli.evaluation import perceptual
from querysplat_cli.evaluation.metrics import Meter
from querysplat_cli.runtime.choices import FurtherMetric
from querysplat_cli.runtime.errors import MissingPart
from querysplat_cli.splat.conventions import EQUAL_PSNR


@pytest.mark.parametrize("size", [(256, 256), (270, 480), (12, 11)])
def test_psnr_and_ssim_are_scikit_images(size: tuple[int, int]) -> None:
    generator = torch.Generator().manual_seed(size[0])
    truth = torch.rand(3, *size, generator=generator)
    picture = (truth + 0.1 * torch.randn(3, *size, generator=generator)).clamp(0, 1)
    scores = Meter().compare(picture, truth)
    one, other = picture.double().numpy(), truth.double().numpy()
    assert scores.psnr == pytest.approx(peak_signal_noise_ratio(other, one, data_range=1), abs=1e-4)
    theirs = structural_similarity(one, other, data_range=1, channel_axis=0, gaussian_weights=True, win_size=11)
    assert scores.ssim == pytest.approx(theirs, abs=1e-6)
    assert scores.lpips is None


@pytest.mark.parametrize("shift", [0.01, 0.1, 0.5])
def test_constant_pictures_have_closed_forms(shift: float) -> None:
    truth = torch.full((3, 40, 40), 0.2)
    scores = Meter().compare(truth + shift, truth)
    assert scores.psnr == pytest.approx(-20 * math.log10(shift), abs=1e-3)
    a, b = 0.2, 0.2 + shift
    assert scores.ssim == pytest.approx((2 * a * b + 1e-4) / (a * a + b * b + 1e-4), abs=1e-5)


def test_equal_pictures() -> None:
    truth = torch.rand(3, 30, 30, generator=torch.Generator().manual_seed(0))
    scores = Meter().compare(truth, truth.clone())
    assert (scores.psnr, scores.ssim) == (EQUAL_PSNR, pytest.approx(1, abs=1e-9))


def test_ssim_is_the_stored_figure(golden: Path) -> None:
    tensors = load_file(golden / "ssim.safetensors")
    for a, b, expected in zip(tensors["a"], tensors["b"], np.asarray(tensors["metric_skimage"]), strict=True):
        assert Meter().compare(a.float(), b.float()).ssim == pytest.approx(float(expected), abs=1e-6)


def test_colour_correction_stands_beside_the_plain_scores() -> None:
    truth = torch.rand(3, 24, 24, generator=torch.Generator().manual_seed(0))
    scores = Meter().compare((truth * 0.6 + 0.1).clamp(0, 1), truth)
    assert scores.psnr < 20
    assert scores.psnr_cc == EQUAL_PSNR
    assert scores.ssim_cc == pytest.approx(1, abs=1e-5)


def test_inria_fits_colours_on_the_left_and_scores_the_right() -> None:
    """A render that is darker on the left alone: the transform of the left half spoils the right one."""
    truth = 0.1 + 0.6 * torch.rand(3, 24, 31, generator=torch.Generator().manual_seed(0))
    even = Meter().compare(truth * 0.5, truth)
    assert min(even.psnr_half, even.psnr_cc) > 70
    assert even.ssim_half == pytest.approx(1, abs=1e-5)
    uneven = truth.clone()
    uneven[..., :15] *= 0.5
    scores = Meter().compare(uneven, truth)
    brightened = (2 * truth[..., 15:]).clamp(0, 1)
    expected = peak_signal_noise_ratio(truth[..., 15:].numpy(), brightened.numpy(), data_range=1)
    assert scores.psnr_half == pytest.approx(expected, abs=0.01)
    assert scores.psnr_half < scores.psnr


@pytest.mark.parametrize(("name", "best"), [("flip", 0.0), ("ssimulacra2", 100.0)])
def test_further_metrics_come_from_their_packages(name: FurtherMetric, best: float) -> None:
    pytest.importorskip({"flip": "flip_evaluator"}.get(name, name))
    truth = torch.rand(3, 40, 48, generator=torch.Generator().manual_seed(0))
    blurred = torch.nn.functional.avg_pool2d(truth, 3, 1, 1)
    same, near, far = (
        getattr(Meter(further=(name,)).compare(picture, truth), name)
        for picture in (truth, 0.9 * truth + 0.1 * blurred, blurred)
    )
    assert same == pytest.approx(best, abs=1e-3)
    assert abs(far - best) > 2 * abs(near - best) > 0
    assert getattr(Meter().compare(truth, truth), name) is None


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(perceptual, "find_spec", lambda name: None)
    with pytest.raises(MissingPart, match="the package flip-evaluator is not installed"):
        perceptual.check_installed("flip")
