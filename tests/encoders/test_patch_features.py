"""Patch features against closed forms."""

import math

import torch

from querysplat_cli.encoders.base import PosedViews
from querysplat_cli.encoders.classical.patch_features import FEATURE_CHANNELS, PATCH, patch_features
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.views import Views


def features_of_a_wall(depth: float) -> torch.Tensor:
    """Features [rows, columns, 12] of a wall at one depth in front of a camera at (1, 2, 3)."""
    height, width = 24, 36
    w2c = torch.eye(4)[None].clone()
    w2c[0, :3, 3] = torch.tensor([-1.0, -2, -3])
    K = torch.tensor([[[30.0, 0, 18], [0, 30, 12], [0, 0, 1]]])
    image = torch.zeros(1, 3, height, width)
    image[0, 0] = 0.75
    image[0, :, :, ::2] += 0.25 * torch.tensor([1.0, 1, 1])[:, None, None]
    masks = torch.ones(1, height, width, dtype=torch.bool)
    views = Views(image, masks, ("wall.png",), ((height, width),))
    scene = PosedViews(views, Cameras(w2c, K, height, width), torch.zeros(0, 3), (torch.zeros(0, dtype=torch.long),))
    rows = patch_features(scene, torch.full((1, height, width), depth), torch.full((1, height, width), 0.5))
    assert rows.shape == (1, (height // PATCH) * (width // PATCH), FEATURE_CHANNELS)
    return rows.reshape(height // PATCH, width // PATCH, FEATURE_CHANNELS)


def test_position_is_the_back_projection_of_the_middle_pixel_in_the_world():
    found = features_of_a_wall(2.0)[1, 4]
    # Row 1 and column 4: the pixel in row 9, column 27, whose centre is at (27.5, 9.5).
    expected = torch.tensor([1 + 2 * (27.5 - 18) / 30, 2 + 2 * (9.5 - 12) / 30, 3 + 2])
    torch.testing.assert_close(found[:3], expected)


def test_a_facing_wall_has_its_normal_towards_the_camera():
    found = features_of_a_wall(2.0)
    torch.testing.assert_close(found[..., 3:6], torch.tensor([0.0, 0, -1]).expand(4, 6, 3))


def test_confidence_colour_log_depth_and_texture():
    found = features_of_a_wall(5.0)[2, 3]
    expected = torch.tensor([0.5, 0.875 - 0.5, 0.125 - 0.5, 0.125 - 0.5, math.log(5), 0.125])
    torch.testing.assert_close(found[6:], expected)
