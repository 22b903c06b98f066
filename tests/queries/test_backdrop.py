"""Far Gaussians behind everything, in blurred colours of the photos."""

from dataclasses import replace

import pytest
import torch

from querysplat_cli.queries.backdrop import backdrop
from querysplat_cli.queries.policy import QUERY_POLICY
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import SH_0, Gaussians, joined
from querysplat_cli.scene.rotations import quaternion_to_matrix
from querysplat_cli.scene.views import Views
from querysplat_cli.splat.render import render

SIZE = 64
RED, BLUE = torch.tensor([0.9, 0.1, 0.1]), torch.tensor([0.1, 0.2, 0.9])


def some_gaussians(spread: float = 0.5, bands: int = 4) -> Gaussians:
    """A few small ones around (0, 0, 2)."""
    random = torch.Generator().manual_seed(0)
    return Gaussians(
        torch.randn(200, 3, generator=random) * spread + torch.tensor([0.0, 0.0, 2.0]),
        torch.tensor([1.0, 0, 0, 0]).repeat(200, 1),
        torch.full((200, 3), 0.01),
        torch.full((200,), 0.9),
        torch.zeros(200, bands, 3),
    )


def photos(*colours: torch.Tensor, turned: bool = False) -> tuple[Views, Cameras]:
    """Photos of one colour each; every second camera looks the other way if `turned`."""
    count = len(colours)
    w2c = torch.eye(4).repeat(count, 1, 1)
    w2c[:, 0, 3] = 0.1 * torch.arange(count)
    if turned:
        w2c[1::2] = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0])) @ w2c[1::2]
    K = torch.tensor([[64.0, 0, 32], [0, 64, 32], [0, 0, 1]]).repeat(count, 1, 1)
    images = torch.stack(colours)[:, :, None, None].expand(-1, -1, SIZE, SIZE).clone()
    masks = torch.ones(count, SIZE, SIZE, dtype=torch.bool)
    names = tuple(f"{i}.png" for i in range(count))
    return Views(images, masks, names, ((SIZE, SIZE),) * count), Cameras(w2c, K, SIZE, SIZE)


def test_holes_show_the_photos_colour_and_not_the_background() -> None:
    views, cameras = photos(RED, RED)
    behind = backdrop(some_gaussians(), views, cameras)
    for level in (0.0, 1.0):
        picture = render(behind, cameras, background=torch.full((3,), level)).colour
        torch.testing.assert_close(picture, RED[None, :, None, None].expand_as(picture), atol=0.02, rtol=0)


def test_the_scene_hides_the_backdrop() -> None:
    views, cameras = photos(RED, RED)
    before = some_gaussians()
    whole = joined(before, backdrop(before, views, cameras))
    drawn, alone = render(whole, cameras), render(before, cameras)
    expected = alone.colour + (1 - alone.alpha[:, None]) * RED[None, :, None, None]
    torch.testing.assert_close(drawn.colour, expected, atol=0.02, rtol=0)


def test_it_lies_behind_every_gaussian_and_faces_the_cameras() -> None:
    views, cameras = photos(RED, RED)
    far = replace(some_gaussians(), means=some_gaussians().means * torch.linspace(1, 30, 200)[:, None])
    behind = backdrop(far, views, cameras)
    centre = cameras.centres.mean(0)
    distance = (behind.means - centre).norm(dim=1)
    arms = far.means - centre
    towards = torch.nn.functional.normalize(behind.means - centre, dim=1)
    nearest = (torch.nn.functional.normalize(arms, dim=1) @ towards.T).max(1)
    ahead = nearest.values > 0.999
    assert int(ahead.sum()) > 100
    assert (distance[nearest.indices] > 1.1 * arms.norm(dim=1))[ahead].all()
    normal = quaternion_to_matrix(behind.quats)[:, :, 2]
    torch.testing.assert_close((normal * towards).sum(1), torch.ones(len(behind)), atol=1e-4, rtol=0)


def test_it_is_little_larger_than_the_scene_even_where_that_is_flat() -> None:
    views, cameras = photos(RED, RED)
    flat = replace(some_gaussians(), means=some_gaussians().means * torch.tensor([1.0, 0.0, 1.0]))
    for scene in (some_gaussians(), flat, some_gaussians()[:1]):
        behind = backdrop(scene, views, cameras)
        centre = cameras.centres.mean(0)
        farthest = float(((scene.means - centre).norm(dim=1) + 2 * scene.scales.amax(1)).max())
        assert float((behind.means - centre).norm(dim=1).max()) < 1.01 * QUERY_POLICY.backdrop_behind * farthest
        assert behind.finite.all()


def test_where_no_photo_looks_there_is_no_backdrop() -> None:
    views, cameras = photos(RED, RED)
    back = replace(cameras, w2c=torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0])) @ cameras.w2c)
    behind = backdrop(some_gaussians(), views, cameras)
    assert float(render(behind, back).alpha.max()) < 0.01
    K = cameras.K.clone()
    K[:, 0, 2] += 0.9 * QUERY_POLICY.backdrop_margin * SIZE  # looks beside the photos, but within the margin
    assert float(render(behind, replace(cameras, K=K)).alpha.min()) > 0.9


def test_each_direction_has_the_colours_of_its_own_photos() -> None:
    views, cameras = photos(RED, BLUE, turned=True)
    behind = backdrop(some_gaussians(), views, cameras)
    for view, colour in enumerate((RED, BLUE)):
        picture = render(behind, cameras[[view]]).colour[0]
        torch.testing.assert_close(picture, colour[:, None, None].expand_as(picture), atol=0.02, rtol=0)


def test_far_parts_of_a_photo_count_more_than_near_ones() -> None:
    """Near red and far blue stripes, which are finer than a cell."""
    views, cameras = photos(RED)
    stripes = (torch.arange(SIZE) // 2 % 2).bool()
    views.images[0] = torch.where(stripes, BLUE[:, None, None], RED[:, None, None])
    x, y = torch.meshgrid(torch.arange(SIZE) + 0.5, torch.arange(SIZE) + 0.5, indexing="xy")
    depth = torch.where(stripes, 4.0, 1.0).expand(SIZE, SIZE)
    means = torch.stack([(x - 32) / 64 * depth, (y - 32) / 64 * depth, depth], -1).reshape(-1, 3)
    count = len(means)
    scene = Gaussians(
        means,
        torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        (means[:, 2:] / 64 * 0.3).expand(-1, 3).clone(),
        torch.full((count,), 0.99),
        torch.zeros(count, 1, 3),
    )
    colour = render(backdrop(scene, views, cameras), cameras).colour[0].mean((1, 2))
    assert float(colour[2]) > 2 * float(colour[0])


@pytest.mark.parametrize("bands", [1, 4, 9])
def test_masked_pixels_have_no_colour(bands: int) -> None:
    views, cameras = photos(RED)
    views.images[0, :, :, 32:] = 0.0
    views.masks[0, :, 32:] = False
    behind = backdrop(some_gaussians(bands=bands), views, cameras)
    picture = render(behind, cameras).colour[0]
    torch.testing.assert_close(picture, RED[:, None, None].expand_as(picture), atol=0.02, rtol=0)
    assert behind.sh.shape[1] == bands


@pytest.mark.parametrize("side", [0, 1])
def test_the_last_columns_and_rows_of_a_photo_are_continued_too(side: int) -> None:
    """448 × 336 pixels were cut into cells of 42, so that the last 28 columns were no part of any cell."""
    size = [336, 448] if side else [448, 336]
    edge = torch.zeros(3, *size)
    edge[0].narrow(side, size[side] - 28, 28).fill_(1.0)
    K = torch.tensor([[[400.0, 0, size[1] / 2], [0, 400.0, size[0] / 2], [0, 0, 1]]])
    cameras = Cameras(torch.eye(4)[None], K, *size)
    views = Views(edge[None], torch.ones(1, *size, dtype=torch.bool), ("a",), (tuple(size),))
    behind = backdrop(some_gaussians(bands=1), views, cameras)
    red = 0.5 + SH_0 * behind.sh[:, 0, 0]
    assert float(red.max()) > 0.5
