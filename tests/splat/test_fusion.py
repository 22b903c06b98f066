"""Depth of several views becomes one closed surface in the right place, colour and orientation."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.formats.mesh import TriangleMesh
from querysplat_cli.scene.gaussians import SH_0, Gaussians, joined
from querysplat_cli.scene.paths import look_at
from querysplat_cli.splat.fusion import FUSION_POLICY, fused

pytest.importorskip("skimage")
COUNT = 3000
SIZES = [(96, 96)] * 8
SMALL = replace(FUSION_POLICY, voxels=64**3)


def ball() -> Gaussians:
    """The unit sphere, red where x is positive and blue elsewhere."""
    i = torch.arange(COUNT) + 0.5
    height, turn = 1 - 2 * i / COUNT, i * 2.399963
    means = torch.stack([(1 - height**2).sqrt() * turn.cos(), (1 - height**2).sqrt() * turn.sin(), height], 1)
    red = (means[:, 0] > 0).float()
    colours = torch.stack([red, torch.zeros(COUNT), 1 - red], 1)
    quats = torch.tensor([1.0, 0, 0, 0]).repeat(COUNT, 1)
    sh = ((colours - 0.5) / SH_0)[:, None]
    return Gaussians(means, quats, torch.full((COUNT, 3), 0.03), torch.full((COUNT,), 0.95), sh)


def mist() -> Gaussians:
    """Faint Gaussians around the ball, and a small opaque one far from it."""
    random = torch.Generator().manual_seed(0)
    means = torch.nn.functional.normalize(torch.randn(60, 3, generator=random), dim=1) * 1.5
    found = ball()[:61].map(torch.clone)
    means = torch.cat([means, torch.tensor([[0.0, 1.8, 0.0]])])
    opacities = torch.full((61,), 0.1).index_fill(0, torch.tensor(60), 0.95)
    return replace(found, means=means, opacities=opacities, scales=torch.full((61, 3), 0.04))


def around() -> Cameras:
    """Six cameras around the ball, slightly above and below it, and one on either side of its axis."""
    places = [[4 * np.cos(a), 4 * np.sin(a), 1.5 * (-1) ** n] for n, a in enumerate(np.arange(6) * np.pi / 3)]
    K = torch.tensor([[[110.0, 0, 48], [0, 110, 48], [0, 0, 1]]])
    like = Cameras(torch.eye(4)[None], K, 96, 96)
    return look_at(np.array([*places, [0.1, 0, 4], [0.1, 0, -4]]), np.zeros(3), np.array([0.0, 1e-3, 1.0]), like)


@pytest.fixture(scope="module")
def mesh() -> TriangleMesh:
    return fused(joined(ball(), mist()), around(), SIZES, lambda text, fraction: None, SMALL)


def test_it_lies_where_the_surface_is_and_faces_outwards(mesh: TriangleMesh) -> None:
    radius = np.linalg.norm(mesh.places, axis=1)
    assert 0.97 < np.quantile(radius, 0.02) < np.quantile(radius, 0.98) < 1.08  # Gaussians are 0.03 thick
    assert radius.max() < 1.2  # neither mist nor the island
    corners = mesh.places[mesh.triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    outwards = (normals * corners.mean(1)).sum(1)
    assert (outwards > 0).mean() > 0.98
    sides = torch.nn.functional.normalize(ball().means, dim=1).numpy()
    assert cKDTree(mesh.places / radius[:, None]).query(sides)[0].max() < 0.2  # no hole


def test_it_has_the_colours_of_the_renders(mesh: TriangleMesh) -> None:
    assert mesh.colours.dtype == np.uint8
    right, left = mesh.colours[mesh.places[:, 0] > 0.2], mesh.colours[mesh.places[:, 0] < -0.2]
    assert right[:, 0].mean() > 200 > 50 > right[:, 2].mean()
    assert left[:, 2].mean() > 200 > 50 > left[:, 0].mean()


def test_what_lies_beyond_the_pictures_is_no_surface() -> None:
    """A picture on the left of its canvas shows a part of the ball."""
    camera = around()[[6]]
    whole, half = (fused(ball(), camera, [size], lambda text, fraction: None, SMALL) for size in ((96, 96), (96, 40)))
    x, _, _ = camera.project(torch.from_numpy(half.places), 0)
    every, _, _ = camera.project(torch.from_numpy(whole.places), 0)
    assert every.max() > 60
    assert x.max() < 42


def test_cameras_that_see_nothing_make_no_mesh() -> None:
    away = around()
    with pytest.raises(QuerySplatError, match="no surface"):
        fused(replace(ball(), means=ball().means + 100), away, SIZES, lambda text, fraction: None, SMALL)
