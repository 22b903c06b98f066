"""The depth of a surface does not move for what is faint in front of it, or hidden behind it."""

import torch

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians, joined
from querysplat_cli.splat.render import render
from querysplat_cli.splat.surface_depth import SurfaceDepth, surface_depth

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


def surface(scene: Gaussians) -> SurfaceDepth:
    return surface_depth(scene, CAMERA, render(scene, CAMERA))


def test_one_surface_has_its_depth_and_the_confidence_of_its_coverage() -> None:
    found = surface(wall(3.0, 0.95))
    torch.testing.assert_close(found.depth[5:27, 2:10], torch.full((22, 8), 3.0))
    assert float(found.confidence[5:27, 2:10].min()) > 0.9
    assert float(found.confidence[:, 24:].max()) == float(found.depth[:, 24:].max()) == 0


def test_what_is_faint_does_not_move_it() -> None:
    """The mean depth lies between both walls; that of the surface is where most of the coverage is."""
    for faint, opaque in ((2.0, 6.0), (6.0, 2.0)):
        near, far = sorted([wall(faint, 0.1), wall(opaque, 0.6)], key=lambda each: float(each.means[0, 2]))
        both = joined(near, far)
        picture, found = render(both, CAMERA), surface(both)
        inside = slice(5, 27), slice(2, 10)
        assert float((picture.depth[0][inside] - opaque).abs().min()) > 0.05
        torch.testing.assert_close(found.depth[inside], torch.full((22, 8), opaque), atol=1e-3, rtol=0)
        assert float(found.confidence[inside].max()) < float(picture.alpha[0][inside].min())


def test_nothing_in_front_of_the_camera() -> None:
    found = surface(wall(-3.0, 0.95))
    assert float(found.depth.max()) == float(found.confidence.max()) == 0
