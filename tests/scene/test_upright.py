"""The up direction of hand-held photos."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from test_paths import CAMERA, MIDDLE, UP, ring

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.paths import look_at
from querysplat_cli.scene.sim3 import Sim3
from querysplat_cli.scene.upright import up_direction

ANYHOW = Sim3(3.0, torch.from_numpy(Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()), torch.zeros(3).double())


def rolled(cameras: Cameras, degrees: dict[int, float]) -> Cameras:
    """Some pictures turned about their direction of view."""
    w2c = cameras.w2c.clone()
    for view, angle in degrees.items():
        turn = torch.from_numpy(Rotation.from_euler("z", angle, degrees=True).as_matrix()).to(w2c)
        w2c[view, :3] = turn @ w2c[view, :3]
    return Cameras(w2c, cameras.K, cameras.height, cameras.width)


@pytest.mark.parametrize("turned", [{}, {1: 90}, {0: 90, 5: -90, 7: 180}])
def test_it_is_found_in_any_frame_although_some_pictures_lie_on_their_side(turned: dict[int, float]) -> None:
    cameras = rolled(ring(np.arange(0, 150, 15)), turned).transformed(ANYHOW)
    assert float(up_direction(cameras) @ (ANYHOW.rotation.numpy() @ UP)) > np.cos(np.deg2rad(0.5))


def test_tilted_pictures_that_look_different_ways_give_the_true_up() -> None:
    places = np.array([[4.0, -3, 0], [0, -2.5, -4], [-4, -3, 1]]) + MIDDLE.numpy()
    cameras = look_at(places, MIDDLE.double().numpy(), UP, CAMERA)
    assert float(up_direction(cameras) @ UP) > np.cos(np.deg2rad(0.2))


def test_pictures_that_contradict_each_other_give_that_of_the_first() -> None:
    pair = rolled(ring(np.array([0.0, 0.0]), height=0.0), {1: 180})
    np.testing.assert_allclose(up_direction(pair), UP, atol=1e-6)
