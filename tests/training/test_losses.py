"""Training losses against closed forms and float64, and at their limits.

The limits are coincident points, opacities of 0, constant pictures, and points behind a camera: cases 28 to 31 in
docs/reference/stability-cases.md.
"""

import math

import pytest
import torch
from torch import Tensor

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.views import Views
from querysplat_cli.training.losses import (
    EPSILON,
    chamfer,
    depth_points,
    draw_indices,
    nearest,
    opacity_floor,
    picture_loss,
)
from querysplat_cli.training.visibility import outside, unseen_loss


def camera(height: int = 20, width: int = 30) -> Cameras:
    K = torch.tensor([[25.0, 0, width / 2], [0, 25.0, height / 2], [0, 0, 1]])
    return Cameras(torch.eye(4)[None], K[None], height, width)


def slope(loss: Tensor, at: Tensor) -> Tensor:
    (gradient,) = torch.autograd.grad(loss, at)
    return gradient


def test_chamfer_of_two_pairs_by_hand() -> None:
    a = torch.tensor([[0.0, 0, 0], [4, 0, 0]])
    b = torch.tensor([[1.0, 0, 0], [4, 3, 0], [10, 0, 0]])
    # a to b: 1 and 9; b to a: 1, 9 and 36.
    assert float(chamfer(a, b)) == pytest.approx(10 / 2 + 46 / 3)


def test_chamfer_agrees_with_all_distances_in_float64() -> None:
    generator = torch.Generator().manual_seed(0)
    a, b = (torch.randn(n, 3, generator=generator, dtype=torch.float64).requires_grad_() for n in (150, 90))
    squares = (a[:, None] - b).square().sum(-1)
    expected = squares.min(1).values.mean() + squares.min(0).values.mean()
    torch.testing.assert_close(chamfer(a, b), expected)
    torch.testing.assert_close(slope(chamfer(a, b), a), slope(expected, a))


def test_neighbours_are_the_same_by_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    generator = torch.Generator().manual_seed(1)
    a, b = (torch.randn(n, 3, generator=generator) for n in (200, 130))
    whole = nearest(a, b)
    monkeypatch.setattr("querysplat_cli.training.losses.CHAMFER_PAIRS", 7 * 130)
    torch.testing.assert_close(nearest(a, b), whole)


@pytest.mark.parametrize(
    ("a", "b"),
    [
        (torch.zeros(4, 3), torch.zeros(3, 3)),
        (torch.zeros(1, 3), torch.ones(1, 3)),
        (torch.zeros(0, 3), torch.ones(5, 3)),
        (1e6 * torch.rand(50, 3), 1e6 * torch.rand(40, 3) + 1e6),
    ],
    ids=["coincident", "one point", "no point", "1e6"],
)
def test_chamfer_stays_finite(a: Tensor, b: Tensor) -> None:
    a = a.requires_grad_()
    loss = chamfer(a, b)
    assert loss.isfinite()
    assert slope(loss, a).isfinite().all()


def test_far_from_the_origin_the_nearest_neighbour_is_still_right() -> None:
    a = torch.tensor([[1e6, 0.0, 0.0]])
    b = torch.tensor([[1e6 + 0.5, 0, 0], [1e6 + 0.25, 0, 0]])
    assert nearest(a, b).tolist() == [1]


def test_opacity_floor_by_hand() -> None:
    opacities = torch.tensor([0.0, 0.01, 0.2, 0.9], dtype=torch.float64).requires_grad_()
    loss = opacity_floor(opacities, 0.1)
    expected = (math.log(0.1 / EPSILON) + math.log(10)) / 4
    assert float(loss.detach()) == pytest.approx(expected, rel=1e-12)
    gradient = slope(loss, opacities)
    assert gradient.isfinite().all()
    assert (gradient < 0).tolist() == [False, True, False, False]
    assert float(opacity_floor(torch.tensor([0.1]), 0.1)) == pytest.approx(0, abs=1e-7)


def test_a_centre_behind_every_camera_is_pulled_forward_though_its_mirror_image_is_visible() -> None:
    centre = torch.tensor([[0.01, 0.0, -0.5]]).requires_grad_()
    loss = unseen_loss(centre, [camera()], 0.025)
    assert float(loss.detach()) == pytest.approx(0.525)
    assert slope(loss, centre)[0, 2] == -1


def looking_along_x(centre: tuple[float, float, float]) -> Cameras:
    """A camera at `centre` whose axes x, y, z point along −z, y, x of the world."""
    rotation = torch.tensor([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]])
    w2c = torch.eye(4)
    w2c[:3, :3], w2c[:3, 3] = rotation, -rotation @ torch.tensor(centre)
    return Cameras(w2c[None], camera().K, 20, 30)


def test_a_centre_behind_one_camera_and_beside_another_is_seen_by_neither() -> None:
    """Its mirrored projection lies inside the first picture, and it is in front of the second camera."""
    behind, beside = camera(), looking_along_x((-1.0, 0.0, -20.0))
    centre = torch.tensor([[0.0, 0.0, -5.0]])
    assert float(outside(centre, behind)) == 0
    assert float((beside.w2c[0, :3] @ torch.tensor([0.0, 0, -5, 1]))[2]) == 1
    assert float(unseen_loss(centre, [behind, beside], 0.025)) == 1
    # Without the limit: 5.025 behind the first near plane; 15 · 25 pixels beside the second picture's middle.
    centre.requires_grad_()
    whole = unseen_loss(centre, [behind, beside], 0.025, limit=0.0)
    assert float(whole.detach()) == pytest.approx(5.025)
    assert slope(whole, centre)[0].tolist() == [0, 0, -1]


def test_a_centre_that_any_view_sees_costs_nothing() -> None:
    """Input views count as much as targets, and one view that sees the centre is enough."""
    seen = torch.tensor([[0.1, 0.0, 3.0]])
    away = looking_along_x((50.0, 0.0, 0.0))
    assert float(unseen_loss(seen, [away], 0.025)) == 1
    assert float(unseen_loss(seen, [camera(), away], 0.025)) == 0
    assert float(unseen_loss(seen, [away, camera()], 0.025)) == 0


@pytest.mark.parametrize("z", [0.0, 1e-30, -1e-30, 1e6])
def test_centres_in_the_camera_plane_give_finite_losses(z: float) -> None:
    centre = torch.tensor([[0.3, -2.0, z]]).requires_grad_()
    loss = unseen_loss(centre, [camera()], 0.025)
    assert loss.isfinite()
    assert slope(loss, centre).isfinite().all()


def test_picture_loss_is_l1_and_ssim_and_the_weighted_distance_in_float32() -> None:
    generator = torch.Generator().manual_seed(2)
    picture, photo = (torch.rand(2, 3, 24, 32, generator=generator) for _ in range(2))
    mask = torch.ones(2, 24, 32, dtype=torch.bool)
    seen = []

    def distance(one: Tensor, other: Tensor) -> Tensor:
        seen.append((one.dtype, torch.is_autocast_enabled("cpu")))
        return (one - other).square().mean()

    plain = picture_loss(picture, photo, mask)
    with torch.autocast("cpu", torch.bfloat16):
        both = picture_loss(picture, photo, mask, distance, 0.5)
    assert seen == [(torch.float32, False)]
    torch.testing.assert_close(both, plain + 0.5 * (picture - photo).square().mean())


def test_the_perceptual_distance_does_not_see_what_is_masked() -> None:
    picture, photo = torch.zeros(1, 3, 12, 12), torch.ones(1, 3, 12, 12)
    mask = torch.zeros(1, 12, 12, dtype=torch.bool)
    mask[:, :6] = True
    loss = picture_loss(picture, photo, mask, lambda a, b: (a - b).abs().mean(), 1.0)
    assert float(loss) == pytest.approx(float(picture_loss(picture, photo, mask)) + 0.5)


@pytest.mark.parametrize("size", [(20, 30), (3, 2)], ids=["usual", "smaller than the window"])
@pytest.mark.parametrize("same", [True, False])
def test_constant_pictures_have_a_loss_and_a_gradient(size: tuple[int, int], same: bool) -> None:
    picture = torch.full((1, 3, *size), 0.4).requires_grad_()
    photo = torch.full((1, 3, *size), 0.4 if same else 0.2)
    loss = picture_loss(picture, photo, torch.ones(1, *size, dtype=torch.bool))
    assert loss.isfinite()
    assert float(loss.detach()) == pytest.approx(0, abs=1e-6) if same else float(loss.detach()) > 0.2
    assert slope(loss, picture).isfinite().all()


def test_depth_points_lie_at_the_depth_and_inside_the_masks() -> None:
    cameras = camera()
    masks = torch.zeros(1, 20, 30, dtype=torch.bool)
    masks[:, :, :10] = True
    views = Views(torch.zeros(1, 3, 20, 30), masks, ("a",), ((20, 30),))
    points = depth_points(views, cameras, torch.full((1, 20, 30), 2.0), 50, torch.Generator().manual_seed(0))
    assert points.shape == (50, 3)
    assert (points[:, 2] == 2).all()
    assert (points[:, 0] < 2 * (10 - 15) / 25).all()
    assert len(points.unique(dim=0)) == 50
    assert len(draw_indices(7, 50, torch.Generator())) == 7
