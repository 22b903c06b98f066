"""The one pass of the CPU splatter gives what the reference gives in two: picture, residual, descent and weights."""

import pytest
import torch
from tests.splat.splat_scenes import as_kernel_sees, close_gradients

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.splat.attribution import attribute
from querysplat_cli.splat.blending_weights import blending_weights
from scenes import FIELDS, camera, cloud


@pytest.mark.parametrize("grey", [0.0, 0.5])
def test_one_pass_equals_the_reference(grey: float) -> None:
    cameras, background = camera(24, 31), torch.tensor([grey, grey / 2, 0.0])
    exact = as_kernel_sees(cloud(3, 80, cameras, degree=1))
    generator = torch.Generator().manual_seed(0)
    photo, mask = torch.rand(3, 24, 31, generator=generator), torch.rand(24, 31, generator=generator) < 0.8
    fast = attribute(exact.to(torch.float32), cameras, photo, mask, background)
    slow = attribute(exact, cameras.to(torch.float64), photo.double(), mask, background.double())
    torch.testing.assert_close(fast.residual.double(), slow.residual, atol=1e-5, rtol=0)
    assert slow.residual[:, ~mask].abs().max() == 0
    for part in ("colour", "alpha"):
        torch.testing.assert_close(getattr(fast.picture, part).double(), getattr(slow.picture, part), atol=1e-5, rtol=0)
    covered = slow.picture.alpha > 0.1
    torch.testing.assert_close(fast.picture.depth.double()[covered], slow.picture.depth[covered], rtol=1e-4, atol=0)
    for name in FIELDS:
        close_gradients(getattr(fast.descent, name), getattr(slow.descent, name), 1e-4, name)
    torch.testing.assert_close(fast.weights.double(), slow.weights, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(fast.weights, blending_weights(exact.to(torch.float32), cameras), rtol=1e-5, atol=1e-5)


def test_numbers_that_are_none_are_refused() -> None:
    cameras = camera(8, 8)
    scene = cloud(0, 5, cameras).to(torch.float32)
    scene.means[2, 1] = torch.nan
    with pytest.raises(QuerySplatError, match="NaN"):
        attribute(scene, cameras, torch.zeros(3, 8, 8), torch.ones(8, 8, dtype=torch.bool), torch.zeros(3))
