"""Moving a scene and its cameras together changes no picture."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from querysplat_cli.scene.sim3 import Sim3
from querysplat_cli.splat.projection import basis
from querysplat_cli.splat.render import RenderSettings, render
from querysplat_cli.splat.transform import rotate_sh, transform_gaussians
from scenes import camera, cloud


def similarity(seed: int, scale: float = 1.0) -> Sim3:
    turn = torch.from_numpy(Rotation.random(random_state=seed).as_matrix())
    return Sim3(scale, turn, torch.randn(3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("scale", [0.3, 1.0, 5.0])
def test_the_picture_stays(degree: int, scale: float) -> None:
    cameras = camera(40, 56, views=2)
    scene, move = cloud(1, 200, cameras, degree=degree), similarity(degree, scale)
    settings = RenderSettings(near=0.025 * scale, far=125 * scale)
    before = render(scene, cameras, backend="reference").colour
    there = transform_gaussians(scene, move)
    after = render(there, cameras.transformed(move), settings=settings, backend="reference").colour
    assert float(before.mean()) > 0.05
    torch.testing.assert_close(after, before, atol=1e-9, rtol=0)


@given(seed=st.integers(0, 10_000), degree=st.integers(0, 3))
def test_colours_turn_with_their_directions(seed: int, degree: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    sh = torch.randn(3, (degree + 1) ** 2, 3, generator=generator, dtype=torch.float64)
    turn = similarity(seed).rotation
    directions = torch.nn.functional.normalize(torch.randn(20, 3, generator=generator, dtype=torch.float64), dim=1)
    seen = torch.einsum("db,nbc->dnc", basis(directions)[:, : sh.shape[1]], sh)
    turned = torch.einsum("db,nbc->dnc", basis(directions @ turn.T)[:, : sh.shape[1]], rotate_sh(sh, turn))
    torch.testing.assert_close(turned, seen, atol=1e-9, rtol=0)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 3.14159265358979, 2.5])
def test_every_angle_has_its_quaternion(angle: float) -> None:
    turn = torch.from_numpy(Rotation.from_rotvec([0, angle * 0.6, angle * 0.8]).as_matrix())
    scene = cloud(2, 30, camera(20, 20), degree=0)
    there = transform_gaussians(scene, Sim3(1.0, turn, torch.zeros(3, dtype=torch.float64)))
    back = transform_gaussians(there, Sim3(1.0, turn.T, torch.zeros(3, dtype=torch.float64)))
    direction = torch.nn.functional.normalize(scene.quats, dim=1)
    returned = torch.nn.functional.normalize(back.quats, dim=1)
    torch.testing.assert_close((direction * returned).sum(1).abs(), torch.ones(30, dtype=torch.float64))
