"""Quantiles of more values than torch's own takes."""

import torch

from querysplat_cli.commands.viewed_scene import framing
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.quantiles import picked


def test_each_is_one_of_the_values_along_the_first_axis() -> None:
    values = torch.tensor([[3.0, 30], [1, 10], [2, 20], [5, 50], [4, 40]])
    assert picked(values, 0.0, 0.5, 1.0).tolist() == [[1, 10], [3, 30], [5, 50]]


def test_the_viewer_frames_more_gaussians_than_torchs_quantile_takes() -> None:
    count = 2**24 + 1
    scales = torch.full((1, 3), 0.1).expand(count, 3)
    one = torch.ones(1)
    many = Gaussians(
        torch.zeros(1, 3).expand(count, 3), one.expand(count, 4), scales, one.expand(count), one.expand(count, 1, 3)
    )
    assert framing(many, None)["sizes"] == [scales[0, 0].item()] * 2
