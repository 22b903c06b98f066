"""Which Gaussians stand for surfaces."""

import pytest
import torch

from querysplat_cli.scene.formats.point_cloud import points_of
from querysplat_cli.scene.gaussians import Gaussians


def of_opacities(opacities: torch.Tensor) -> Gaussians:
    count = len(opacities)
    quats, scales = torch.ones(count, 4), torch.ones(count, 3)
    return Gaussians(torch.randn(count, 3), quats, scales, opacities, torch.zeros(count, 1, 3))


@pytest.mark.parametrize(
    ("opacities", "expected"),
    [
        (torch.linspace(0, 1, 101), 51),  # half of them are half opaque
        (torch.linspace(0, 0.4, 100), 26),  # a scene of faint Gaussians has its most opaque quarter, and a tie
        (torch.zeros(0), 0),
    ],
)
def test_half_opaque_or_the_most_opaque_quarter(opacities: torch.Tensor, expected: int) -> None:
    scene = of_opacities(opacities)
    assert int(scene.surfaces.sum()) == expected == len(points_of(scene))
    assert scene.opacities[scene.surfaces].equal(opacities[len(opacities) - expected :])
