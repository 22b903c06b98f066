"""Depth becomes smooth where the photo is plain, and may change where the photo has an edge."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor
from tto_scenes import wall

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.views import Views
from querysplat_cli.splat.render import Rendering, render
from querysplat_cli.tto.gaussians import optimise_gaussians
from querysplat_cli.tto.options import TtoSettings
from querysplat_cli.tto.rendering_loss import RenderingLoss
from querysplat_cli.tto.smooth_depth import EDGE, LARGEST_STEP, depth_roughness


def rendered(depth: Tensor, alpha: float = 1.0) -> Rendering:
    return Rendering(depth.new_zeros(1, 3, *depth.shape), depth.new_full((1, *depth.shape), alpha), depth[None])


def plain(height: int, width: int) -> Tensor:
    return torch.full((1, 3, height, width), 0.5, dtype=torch.float64)


def every(height: int, width: int) -> Tensor:
    return torch.ones(1, height, width, dtype=torch.bool)


def rough_of(depth: Tensor, photo: Tensor, alpha: float = 1.0) -> float:
    """With no depth confirmed."""
    return float(depth_roughness(rendered(depth, alpha), photo, every(*depth.shape), every(*depth.shape)))


def slope(side: int) -> Tensor:
    """Inverse depth from 0.9 to 1.1 across the picture, with a median of 1."""
    nearness = torch.linspace(0.9, 1.1, side + 1, dtype=torch.float64).unfold(0, 2, 1).mean(1)
    return (1 / nearness).expand(side, side)


def test_a_slope_is_as_rough_as_inverse_depth_changes_across_it() -> None:
    for side in (9, 33):  # however large the picture is
        assert rough_of(slope(side), plain(side, side)) == pytest.approx(0.2, rel=1e-9)


def test_it_does_not_depend_on_the_unit_of_length() -> None:
    one, other = (rough_of(unit * slope(9), plain(9, 9)) for unit in (1, 1000))
    assert one == pytest.approx(other, rel=1e-9)


def test_an_edge_of_the_photo_makes_a_step_cheap_and_a_large_step_costs_no_more() -> None:
    photo, depth = plain(8, 8), torch.full((8, 8), 2.0, dtype=torch.float64)
    depth[:, 5:] = 2 / 0.95  # inverse depth falls by 0.05 of its median
    sharp = photo.clone()
    sharp[..., 5:] += 2 * EDGE
    step = rough_of(depth, photo)
    assert step == pytest.approx(8 * 0.05 / 7)
    assert rough_of(depth, sharp) == pytest.approx(step * math.exp(-2))
    depth[:, 5:] = 20
    assert rough_of(depth, photo) == pytest.approx(8 * LARGEST_STEP / 7)


def test_the_canvas_beside_a_smaller_photo_makes_it_no_smoother() -> None:
    """A portrait beside landscapes has the same gradient as a portrait among its like."""
    tilted = wall(12, size=1.2, opacity=0.97)
    tilted.means[:, 2] += 0.3 * tilted.means[:, 0]
    K = torch.tensor([[[60.0, 0, 24], [0, 60.0, 24], [0, 0, 1]]])
    found = []
    for height, width in ((48, 48), (96, 144)):
        images, masks = torch.zeros(1, 3, height, width), torch.zeros(1, height, width, dtype=torch.bool)
        images[..., :48, :48], masks[..., :48, :48] = 0.5, True
        views = Views(images, masks, ("a",), ((48, 48),))
        unsure = (torch.zeros(48, 48, dtype=torch.bool),)
        loss = RenderingLoss(views, Cameras(torch.eye(4)[None], K, height, width), confirmed=unsure)
        with_it, without = (each.value_and_gradient(tilted, [0]) for each in (loss, replace(loss, confirmed=None)))
        found.append(with_it.gradient.means - without.gradient.means)
    assert float(found[0].norm()) > 0
    assert float((found[0] - found[1]).norm()) < 0.02 * float(found[0].norm())


def test_only_steps_between_guessed_pixels_count() -> None:
    depth = torch.full((4, 8), 2.0, dtype=torch.float64)
    depth[:, 2:] = 2 / 0.95
    depth[:, 6:] = 2 / 0.9
    middle = 2 / 0.95
    for guessed_from, rough in ((6, 0.0), (5, 1.0), (2, 1.0), (1, 2.0)):  # how many of the two steps count
        guessed = every(4, 8)
        guessed[:, :, :guessed_from] = False
        found = float(depth_roughness(rendered(depth), plain(4, 8), every(4, 8), guessed))
        assert found == pytest.approx(rough * 8 * middle / 2 * 0.05 / 7)


def test_masked_and_faint_pixels_do_not_count_and_send_back_no_nan() -> None:
    rough = torch.rand(6, 6, dtype=torch.float64) + 1
    assert float(depth_roughness(rendered(rough), plain(6, 6), ~every(6, 6), every(6, 6))) == 0
    assert rough_of(rough, plain(6, 6), alpha=0.4) == 0
    rough[2, 3] = 0  # where nothing is drawn
    leaf = rough.requires_grad_()
    alpha = (rough.detach() > 0).double()[None]
    depth_roughness(replace(rendered(leaf), alpha=alpha), plain(6, 6), every(6, 6), every(6, 6)).backward()
    assert leaf.grad is not None
    assert leaf.grad.isfinite().all()
    assert leaf.grad[2, 3] == 0


def test_its_gradient_is_that_of_differences() -> None:
    generator = torch.Generator().manual_seed(3)
    depth = 2 + 0.1 * torch.rand(5, 7, dtype=torch.float64, generator=generator)
    photo = torch.rand(1, 3, 5, 7, dtype=torch.float64, generator=generator)
    # The median counts as a constant, so it must be another pixel than those that are moved.
    middle = depth.flatten().argsort()[17]

    def rough(some: Tensor) -> Tensor:
        whole = depth.flatten().clone()
        free = torch.arange(35) != middle
        whole[free] = some
        return depth_roughness(rendered(whole.view(5, 7)), photo, every(5, 7), every(5, 7))

    start = depth.flatten()[torch.arange(35) != middle].clone().requires_grad_()
    assert torch.autograd.gradcheck(rough, start, eps=1e-7, atol=1e-6)


def test_optimisation_flattens_a_plain_wall_where_no_view_confirms_its_depth() -> None:
    flat = wall(12, size=1.0, opacity=0.9)
    grey = replace(flat, sh=torch.zeros_like(flat.sh))
    K = torch.tensor([[40.0, 0, 16], [0, 40.0, 16], [0, 0, 1]])[None]
    cameras = Cameras(torch.eye(4)[None], K, 32, 32)
    photo, mask = render(grey, cameras).colour.detach(), every(32, 32)
    means = grey.means.clone()
    means[:, 2] += 0.05 * torch.randn(len(means), generator=torch.Generator().manual_seed(0))
    start = replace(grey, means=means)
    target = RenderingLoss(Views(photo, mask, ("a",), ((32, 32),)), cameras)

    def rough(some: Gaussians) -> float:
        with torch.no_grad():
            return float(depth_roughness(render(some, cameras), photo, mask, mask))

    def optimised(confirmed: Tensor | None) -> float:
        aim = replace(target, confirmed=None if confirmed is None else tuple(confirmed))
        generator = torch.Generator().manual_seed(0)
        return rough(optimise_gaussians(start, aim, TtoSettings(60, 0.02), generator=generator).gaussians)

    left_alone = optimised(None)
    assert optimised(mask) == left_alone
    assert left_alone > 0.7 * rough(start)
    assert optimised(torch.zeros(1, 16, 16, dtype=torch.bool)) < 0.5 * rough(start)  # of smaller pictures


def test_a_small_photo_beside_a_large_one_has_its_own_guesses() -> None:
    """The left halves are confirmed. The working pictures have one size; of the photos, the second is half as large."""
    K = torch.tensor([[40.0, 0, 16], [0, 40.0, 16], [0, 0, 1]]).repeat(2, 1, 1)
    cameras = Cameras(torch.eye(4).repeat(2, 1, 1), K, 32, 32)
    masks = torch.ones(2, 32, 32, dtype=torch.bool)
    masks[1, 16:] = masks[1, :, 16:] = False
    views = Views(torch.zeros(2, 3, 32, 32), masks, ("a", "b"), ((32, 32), (16, 16)))
    left = torch.zeros(8, 8, dtype=torch.bool)
    left[:, :4] = True
    target = RenderingLoss(views, cameras, confirmed=(left, left))
    for view, size in enumerate((32, 16)):
        guessed = target.guessed(view)[0, :size, :size]
        assert not guessed[:, : size // 2].any()
        assert guessed[:, size // 2 :].all()
    assert not target.guessed(1)[0, 16:].any()
