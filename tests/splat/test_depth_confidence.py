"""Confidence of rendered depth: full on one surface, low where two are blended, none where there is nothing."""

import torch

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.splat.depth_confidence import depth_confidence
from querysplat_cli.splat.render import render

CAMERA = Cameras(torch.eye(4)[None], torch.tensor([[[40.0, 0, 16], [0, 40, 16], [0, 0, 1]]]), 32, 32)


def wall(depth: float, opacity: float) -> Gaussians:
    """It covers the left half of the picture."""
    x, y = torch.meshgrid(torch.arange(-2.0, 16.0), torch.arange(-2.0, 35.0), indexing="xy")
    means = torch.stack([(x - 16) / 40 * depth, (y - 16) / 40 * depth, torch.full_like(x, depth)], -1).reshape(-1, 3)
    count = len(means)
    return Gaussians(
        means,
        torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        torch.full((count, 3), depth / 40 * 0.6),
        torch.full((count,), opacity),
        torch.zeros(count, 4, 3),
    )


def confidence(scene: Gaussians) -> torch.Tensor:
    return depth_confidence(scene, CAMERA, render(scene, CAMERA))


def test_one_surface_has_the_confidence_of_its_coverage() -> None:
    found = confidence(wall(3.0, 0.95))
    assert float(found[5:27, 2:10].min()) > 0.9
    assert float(found[:, 24:].max()) == 0


def test_two_surfaces_that_are_blended_have_little() -> None:
    near, far = wall(2.0, 0.2), wall(6.0, 0.95)
    both = Gaussians(**{name: torch.cat([getattr(near, name), getattr(far, name)]) for name in vars(near)})
    alpha = render(both, CAMERA).alpha[0]
    assert float(alpha[5:27, 2:10].min()) > 0.9
    assert float(confidence(both)[5:27, 2:10].max()) < 0.1
