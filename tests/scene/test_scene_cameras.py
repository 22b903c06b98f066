"""Pinhole cameras: intrinsics, and points to pixels and back."""

import torch
from scipy.spatial.transform import Rotation

from querysplat_cli.scene.cameras import Cameras, nearest_first, project_points

K = torch.tensor([[[300.0, 0, 160], [0, 310, 120], [0, 0, 1]], [[280.0, 0, 150], [0, 290, 110], [0, 0, 1]]])


def cameras() -> Cameras:
    w2c = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    w2c[:, :3, :3] = torch.from_numpy(Rotation.random(2, random_state=0).as_matrix())
    w2c[:, :3, 3] = torch.tensor([[0.1, -0.2, 0.3], [1.0, 2.0, -1.0]])
    return Cameras(w2c, K.double(), 240, 320)


def test_intrinsics_are_focal_lengths_then_the_principal_point() -> None:
    fx, fy, cx, cy = cameras().intrinsics
    assert fx.tolist() == [300, 280]
    assert fy.tolist() == [310, 290]
    assert cx.tolist() == [160, 150]
    assert cy.tolist() == [120, 110]


def test_points_of_pixels_are_projected_back_to_them() -> None:
    views = cameras()
    x, y = torch.tensor([0.5, 100.5, 319.5]).double(), torch.tensor([10.5, 200.5]).double()
    points = views.unproject(torch.full((2, 2, 3), 2.5, dtype=torch.float64), x, y)
    expected = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1).reshape(-1, 2)
    for view in range(2):
        found = project_points(points[view].reshape(-1, 3), views.w2c[view], views.K[view])
        torch.testing.assert_close(found, expected)


def test_only_points_in_front_of_the_camera_and_inside_the_picture_are_seen() -> None:
    views = cameras()
    corner = views.unproject(
        torch.full((2, 1, 2), 2.0, dtype=torch.float64),
        torch.tensor([1.0, 321.0]).double(),
        torch.tensor([1.0]).double(),
    )
    inside, outside = corner[0, 0]
    behind = 2 * views.centres[0] - inside
    assert views.sees(torch.stack([inside, outside, behind]), 0).tolist() == [True, False, False]


def test_the_nearest_cameras_are_found_far_from_the_origin() -> None:
    """The frame of an encoder may have any origin."""
    line = torch.arange(60.0)[:, None] * torch.tensor([0.03, 0.04, 0.0])
    found = nearest_first(line + 1000)
    assert found[:, 0].equal(torch.arange(60))
    assert [set(row) for row in found[1:-1, 1:3].tolist()] == [{view - 1, view + 1} for view in range(1, 59)]
