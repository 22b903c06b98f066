"""Metrics against scikit-image, against closed forms, and against the stored figures."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from querysplat_cli.evaluation.metrics import compare
from querysplat_cli.evaluation.policy import EVALUATION_POLICY


@pytest.mark.parametrize("size", [(256, 256), (270, 480), (12, 11)])
def test_psnr_and_ssim_are_scikit_images(size: tuple[int, int]) -> None:
    generator = torch.Generator().manual_seed(size[0])
    truth = torch.rand(3, *size, generator=generator)
    picture = (truth + 0.1 * torch.randn(3, *size, generator=generator)).clamp(0, 1)
    scores = compare(picture, truth, None)
    one, other = picture.double().numpy(), truth.double().numpy()
    assert scores.psnr == pytest.approx(peak_signal_noise_ratio(other, one, data_range=1), abs=1e-4)
    theirs = structural_similarity(one, other, data_range=1, channel_axis=0, gaussian_weights=True, win_size=11)
    assert scores.ssim == pytest.approx(theirs, abs=1e-6)
    assert scores.lpips is None


@pytest.mark.parametrize("shift", [0.01, 0.1, 0.5])
def test_constant_pictures_have_closed_forms(shift: float) -> None:
    truth = torch.full((3, 40, 40), 0.2)
    scores = compare(truth + shift, truth, None)
    assert scores.psnr == pytest.approx(-20 * math.log10(shift), abs=1e-3)
    a, b = 0.2, 0.2 + shift
    assert scores.ssim == pytest.approx((2 * a * b + 1e-4) / (a * a + b * b + 1e-4), abs=1e-5)


def test_equal_pictures() -> None:
    truth = torch.rand(3, 30, 30, generator=torch.Generator().manual_seed(0))
    scores = compare(truth, truth.clone(), None)
    assert (scores.psnr, scores.ssim) == (EVALUATION_POLICY.psnr_limit, pytest.approx(1, abs=1e-9))


def test_ssim_is_the_stored_figure(golden: Path) -> None:
    tensors = load_file(golden / "ssim.safetensors")
    for a, b, expected in zip(tensors["a"], tensors["b"], np.asarray(tensors["metric_skimage"]), strict=True):
        assert compare(a.float(), b.float(), None).ssim == pytest.approx(float(expected), abs=1e-6)


def test_colour_correction_stands_beside_the_plain_scores() -> None:
    truth = torch.rand(3, 24, 24, generator=torch.Generator().manual_seed(0))
    scores = compare((truth * 0.6 + 0.1).clamp(0, 1), truth, None)
    assert scores.psnr < 20
    assert scores.psnr_cc == EVALUATION_POLICY.psnr_limit
    assert scores.ssim_cc == pytest.approx(1, abs=1e-5)
