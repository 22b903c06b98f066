"""Ray-cast rooms: exact depth, colours that agree between views, and cameras that face the furniture."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.training import raycast
from querysplat_cli.training.photographer import cast, packed, walk
from querysplat_cli.training.raycast import BALL, BOX, CYLINDER
from querysplat_cli.training.rooms import make_room
from querysplat_cli.training.solids import Scene, Solid
from querysplat_cli.training.textures import PAINTS

SEEDS = (0, 1, 42)


def solid(shape: int, centre: tuple[float, float, float], size: tuple[float, float, float], **more: object) -> Solid:
    return Solid(shape, centre, size, "plaster", (0.8, 0.7, 0.6), (0.5, 0.4, 0.3), **more)


def scene(*solids: Solid) -> Scene:
    return Scene(solids, (0.0, 0.0, 5.0), (0.0, 5.0, 0.0))


def camera(height: int = 21, width: int = 31, focal: float = 30.0) -> Cameras:
    """At the origin, looking along world y, z up."""
    w2c = torch.tensor([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Cameras(w2c[None], K[None], height, width)


def small(cameras: Cameras) -> Cameras:
    return cameras.resized(72, 96)


def points(cameras: Cameras, depth: torch.Tensor) -> np.ndarray:
    """World points [views, height, width, 3] of the pixel centres."""
    v, u = np.mgrid[: cameras.height, : cameras.width] + 0.5
    K, c2w = cameras.K.double().numpy(), cameras.to(torch.float64).c2w.numpy()
    x = (u - K[:, 0, 2, None, None]) / K[:, 0, 0, None, None]
    y = (v - K[:, 1, 2, None, None]) / K[:, 1, 1, None, None]
    local = np.stack([x, y, np.ones_like(x)], -1) * depth.double().numpy()[..., None]
    return np.einsum("vij,vrcj->vrci", c2w[:, :3, :3], local) + c2w[:, None, None, :3, 3]


def inside(part: Solid, place: np.ndarray) -> np.ndarray:
    """Below 1 inside the solid, 1 on its surface, above 1 outside: the largest of its coordinates' norms."""
    moved = place - np.array(part.centre)
    c, s = math.cos(part.turn), math.sin(part.turn)
    x = (c * moved[..., 0] + s * moved[..., 1]) / part.size[0]
    y = (c * moved[..., 1] - s * moved[..., 0]) / part.size[1]
    z = moved[..., 2] / part.size[2]
    if part.shape == BALL:
        return np.sqrt(x**2 + y**2 + z**2)
    return np.maximum(np.hypot(x, y) if part.shape == CYLINDER else np.maximum(abs(x), abs(y)), abs(z))


def test_depth_of_a_wall_is_constant_and_of_a_floor_follows_the_horizon() -> None:
    view = camera()
    _, depth = cast(scene(solid(BOX, (0, 7, 0), (50, 2, 50))), view)
    np.testing.assert_allclose(depth, 5, rtol=1e-6)
    _, depth = cast(scene(solid(BOX, (0, 0, -4), (500, 500, 2))), view)
    below = (np.arange(21) + 0.5 - 10.5) / 30
    np.testing.assert_allclose(depth[0, 11:, 3], 2 / below[11:], rtol=1e-6)
    assert not depth[0, :10].any()


def test_depth_of_a_ball_and_of_a_pole() -> None:
    view = camera()
    x = (np.arange(31) + 0.5 - 15.5) / 30
    _, depth = cast(scene(solid(BALL, (0, 6, 0), (2, 2, 2))), view)
    # |t (x, 1, 0) - (0, 6, 0)|² = 4, the nearer root.
    root = 36 - 32 * (1 + x**2)
    expected = np.where(root > 0, (6 - np.sqrt(root.clip(0))) / (1 + x**2), 0)
    np.testing.assert_allclose(depth[0, 10], expected, rtol=1e-6)
    _, pole = cast(scene(solid(CYLINDER, (0, 6, 0), (2, 2, 100))), view)
    np.testing.assert_allclose(pole[0], np.tile(expected, (21, 1)), rtol=1e-6)


@pytest.mark.parametrize("shape", [BOX, BALL, CYLINDER])
def test_every_ray_ends_on_a_surface_and_not_behind_one(shape: int) -> None:
    """Turned, stretched and overlapping solids, checked by an independent test for points inside them."""
    chance = np.random.default_rng(shape)
    solids = [
        solid(
            shape,
            (chance.uniform(-2, 2), chance.uniform(4, 8), chance.uniform(-1.5, 1.5)),
            tuple(chance.uniform(0.3, 1.2, 3)),
            turn=chance.uniform(-3, 3),
        )
        for _ in range(12)
    ]
    view = camera(60, 90, 80.0)
    _, depth = cast(scene(*solids), view)
    hit = depth.numpy() > 0
    assert 0.3 < hit.mean() < 1
    nearest = np.min([inside(part, points(view, depth)) for part in solids], 0)
    np.testing.assert_allclose(nearest[hit], 1, atol=2e-5)
    reach = torch.where(depth > 0, depth, torch.tensor(20.0))
    for fraction in np.linspace(0.02, 0.98, 40):
        assert min(inside(part, points(view, reach * fraction)).min() for part in solids) > 1


def test_a_camera_inside_a_box_sees_its_walls() -> None:
    _, depth = cast(scene(solid(BOX, (0, 1, 0), (3, 4, 3))), camera())
    np.testing.assert_allclose(depth[0, 5:15, 5:25], 5, rtol=1e-6)


def test_light_falls_off_into_shadow() -> None:
    """A plate between the lamp and the floor darkens the floor under it, and nothing else."""
    floor = solid(BOX, (0, 5, -1.1), (20, 20, 0.1), casts_shadow=False)
    plate = solid(BOX, (0, 5, 1), (0.4, 0.4, 0.05))
    lit, shaded = (
        cast(replace(scene(*parts), lamp=(0.0, 5.0, 2.5)), camera())[0].mean(1)[0]
        for parts in ((floor,), (floor, plate))
    )
    assert shaded[16, 15] < 0.85 * lit[16, 15]
    torch.testing.assert_close(shaded[20], lit[20])


def test_a_glossy_wall_mirrors_what_stands_behind_the_camera() -> None:
    """Seen straight on it shows the red ball in its middle and nothing, which is black, beside it."""
    wall = solid(BOX, (0, 7, 0), (50, 2, 50))
    ball = Solid(BALL, (0, -3, 0), (1.5, 1.5, 1.5), "plain", (0.9, 0.1, 0.1), (0.9, 0.1, 0.1))
    dull, mirror = (
        cast(replace(scene(replace(wall, gloss=gloss), ball), lamp=(0.0, 3.0, 3.0)), camera())[0][0]
        for gloss in (0, 0.9)
    )
    middle, corner = mirror[:, 10, 15], mirror[:, 0, 0]
    assert middle[0] > 2 * middle[1]
    assert dull[0, 10, 15] < 1.5 * dull[1, 10, 15]
    assert corner.max() < 0.5 * dull[:, 0, 0].max()
    assert torch.equal(cast(scene(wall), camera())[0], cast(scene(replace(wall, gloss=0)), camera())[0])


@pytest.mark.parametrize("paint", PAINTS)
def test_every_paint_has_detail_and_stays_in_range(paint: str) -> None:
    wall = replace(solid(BOX, (0, 2.5, 0), (2, 0.5, 2)), paint=paint)
    image = cast(scene(wall), camera(120, 160, 160.0))[0][0]
    assert image.min() >= 0
    assert image.max() <= 1
    patches = image.mean(0).unfold(0, 20, 20).unfold(1, 20, 20).std((2, 3))
    assert patches.median() > 0.012


def test_the_same_seed_gives_the_same_bits_and_another_seed_another_room() -> None:
    rooms = [make_room(seed) for seed in (*SEEDS, 42)]
    views = [small(walk(room, 2, seed)) for room, seed in zip(rooms, (*SEEDS, 42), strict=True)]
    images = [cast(room, view)[0] for room, view in zip(rooms, views, strict=True)]
    assert torch.equal(images[2], images[3])
    assert torch.equal(images[3][1:], cast(rooms[3], views[3][[1]])[0])
    for i, first in enumerate(images[:3]):
        for second in images[i + 1 : 3]:
            assert (first - second).abs().mean() > 0.08


@pytest.mark.parametrize("seed", SEEDS)
def test_views_agree_on_the_colour_of_what_they_both_see(seed: int) -> None:
    """Points of one view, projected into the next, have the depth and the colour found there."""
    room = make_room(seed)
    views = walk(room, 12, seed)[[5, 6]].resized(240, 320)
    images, depth = cast(room, views)
    place = points(views, depth)[0].reshape(-1, 3)
    w2c, K = views.w2c[1].double().numpy(), views.K[1].double().numpy()
    local = place @ w2c[:3, :3].T + w2c[:3, 3]
    u, v = ((local @ K.T)[:, :2] / local[:, 2:]).T
    seen = (u > 0) & (v > 0) & (u < 320) & (v < 240)
    row, column = v[seen].astype(int), u[seen].astype(int)
    same = np.abs(depth[1].numpy()[row, column] / local[seen, 2] - 1) < 0.01
    assert seen.mean() > 0.7
    assert same.mean() > 0.85
    own = images[0].reshape(3, -1).T.numpy()[seen][same]
    other = images[1].permute(1, 2, 0).numpy()[row, column][same]
    assert np.median(np.abs(own - other)) < 0.02


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("count", [1, 3, 12, 40])
def test_the_photographer_walks_among_the_furniture_not_through_it(seed: int, count: int) -> None:
    room = make_room(seed)
    views = walk(room, count, seed)
    assert (len(views), views.height, views.width) == (count, 480, 640)
    eyes = views.to(torch.float64).centres.numpy()
    assert min(inside(part, eyes).min() for part in room.solids) > 1
    focus = torch.tensor(room.focus)
    local = views.w2c[:, :3, :3] @ focus + views.w2c[:, :3, 3]
    assert (local[:, :2].abs() < 0.2 * local[:, 2:]).all()
    if count > 1:
        turn = torch.rad2deg(torch.acos((views.w2c[1:, 2, :3] * views.w2c[:-1, 2, :3]).sum(1).clamp(-1, 1)))
        assert turn.max() < 15
        assert np.linalg.norm(np.diff(eyes, axis=0), axis=1).max() < 0.9


@given(st.integers(0, 2**32 - 1))
def test_no_solid_that_a_ray_of_a_cone_meets_is_left_out(seed: int) -> None:
    chance = np.random.default_rng(seed)
    parts = [
        solid(int(chance.integers(3)), tuple(chance.normal(0, 4, 3)), tuple(chance.uniform(0.05, 2, 3)), turn=1.0)
        for _ in range(30)
    ]
    table, everything = packed(parts), np.arange(30)
    start, along = chance.normal(0, 4, 3), chance.normal(0, 2, 3)
    reach, growth, longest = chance.uniform(0, 1), chance.uniform(0, 0.3), chance.choice([1.0, np.inf])
    kept = set(raycast.touching(table, everything, start, along, longest, (reach, growth)))
    aside = np.cross(along, chance.normal(size=3))
    aside *= chance.uniform(0, 1) / np.linalg.norm(aside)
    origin = start + reach * aside
    direction = along + (growth * np.linalg.norm(along) if longest > 1 else 0) * aside
    met = [raycast.distance(table, i, tuple(origin), tuple(direction), (direction**2).sum()) for i in everything]
    assert kept >= {i for i in everything if met[i] <= longest and np.isfinite(met[i])}
