"""What was gone for other photos, on a made-up wall with known depth."""

import numpy as np
import pytest
import torch

from querysplat_cli.encoders.base import Geometry
from querysplat_cli.queries.compiled_transients import AGREES, CONTRADICTS, judge_pixels
from querysplat_cli.queries.transients import find_transients, without
from querysplat_cli.scene.cameras import NEAREST_DEPTH, Cameras
from querysplat_cli.scene.views import Views

HEIGHT, WIDTH, VIEWS, FOCAL = 120, 160, 5, 150.0
WALL, PLATE = 4.0, 2.0
BODY = slice(30, 90), slice(60, 84)
"""Where somebody stands in the middle view: rows and columns."""


def texture(x: torch.Tensor, y: torch.Tensor, phase: float) -> torch.Tensor:
    """Smooth colours [..., 3] of a plane, whose neighbours at some distance differ."""
    waves = [torch.sin(a * x + b * y + phase + c) for a, b, c in ((2.1, 0.7, 0.0), (-0.8, 2.6, 1.0), (1.7, -1.9, 2.0))]
    return 0.5 + 0.4 * torch.stack(waves, -1)


def wall(plate: float = 0.0) -> tuple[Views, Cameras, Geometry]:
    """Views side by side of a wall with known depth, and of a plate of this half width before it, whose depth is not.

    The plate's depth is taken for the wall's, with no confidence.
    """
    w2c = torch.eye(4).repeat(VIEWS, 1, 1)
    w2c[:, 0, 3] = -0.25 * torch.arange(VIEWS) + 0.5
    K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]]).repeat(VIEWS, 1, 1)
    x = (torch.arange(WIDTH) + 0.5 - WIDTH / 2) / FOCAL
    y = ((torch.arange(HEIGHT) + 0.5 - HEIGHT / 2) / FOCAL)[:, None].expand(-1, WIDTH)
    images, confidence = [], torch.ones(VIEWS, HEIGHT, WIDTH)
    for view, shift in enumerate(-w2c[:, 0, 3]):
        colour = texture(WALL * x + shift, WALL * y, 0.0)
        on_plate = ((PLATE * x + shift).abs() < plate) & ((PLATE * y).abs() < plate)
        colour[on_plate] = texture(PLATE * x + shift, PLATE * y, 4.0)[on_plate]
        confidence[view][on_plate] = 0
        images.append(colour.permute(2, 0, 1))
    names = tuple(f"{view}.png" for view in range(VIEWS))
    masks = torch.ones(VIEWS, HEIGHT, WIDTH, dtype=torch.bool)
    views = Views(torch.stack(images), masks, names, ((HEIGHT, WIDTH),) * VIEWS)
    geometry = Geometry(torch.full((VIEWS, HEIGHT, WIDTH), WALL), confidence, (), 8)
    return views, Cameras(w2c, K, HEIGHT, WIDTH), geometry


def with_somebody(views: Views, geometry: Geometry) -> None:
    """Somebody before the wall of the middle view, whom no view measures."""
    middle = VIEWS // 2
    views.images[middle, :, *BODY] = torch.tensor([0.05, 0.9, 0.1])[:, None, None]
    assert geometry.confidence is not None
    geometry.confidence[middle, *BODY] = 0


def test_somebody_whom_one_photo_shows_is_found() -> None:
    views, cameras, geometry = wall()
    with_somebody(views, geometry)
    found = find_transients(views, cameras, geometry)
    body = torch.zeros_like(views.masks)
    body[VIEWS // 2, *BODY] = True
    assert found[body].float().mean() > 0.98
    assert found[~body].float().mean() < 0.01
    assert found.flatten(1).any(1).tolist() == [view == VIEWS // 2 for view in range(VIEWS)]


def test_a_plate_that_all_photos_show_is_none_though_its_depth_is_wrong() -> None:
    views, cameras, geometry = wall(plate=0.25)
    assert not find_transients(views, cameras, geometry).any()


def test_a_wall_alone_has_none() -> None:
    assert not find_transients(*wall()).any()


def test_nothing_is_found_where_one_view_alone_measured_what_is_behind() -> None:
    views, cameras, geometry = wall()
    with_somebody(views, geometry)
    assert geometry.confidence is not None
    geometry.confidence[[0, 1, 4]] = 0
    assert not find_transients(views, cameras, geometry).any()


def test_what_is_masked_in_the_others_says_nothing() -> None:
    views, cameras, geometry = wall()
    with_somebody(views, geometry)
    views.masks[[0, 1, 3]] = False
    assert not find_transients(views, cameras, geometry).any()


def test_pixels_without_them_take_no_part() -> None:
    views, _, _ = wall()
    pixels = torch.zeros_like(views.masks)
    pixels[1, 3:5, 7] = True
    hidden = without(views, pixels)
    assert (hidden.masks != pixels).all()
    assert views.masks.all()
    views.hide(1, pixels[1])
    assert torch.equal(views.masks, hidden.masks)


def verdict_of(ray, origin, colour, reach, others, w2c, lenses, limits, depth, confidence, masks, colours):  # type: ignore[no-untyped-def]
    """That of one pixel by the docstring of `transients`, in float64."""
    nearest, same_depth, same_colour, perhaps, fewest, measured = limits
    z, possible = reach[0], False
    while z < reach[1]:
        seen = {"through": 0, "alike": 0, "unlike": 0, "perhaps": 0}
        for other in others:
            local = w2c[other, :3, :3] @ (origin + z * ray) + w2c[other, :3, 3]
            far = local[2]
            if far <= nearest:
                continue
            x, y = local[:2] / far * lenses[other, :2] + lenses[other, 2:]
            if not (0 <= x < depth.shape[2] and 0 <= y < depth.shape[1]) or not masks[other, int(y), int(x)]:
                continue
            there = other, int(y), int(x)
            difference = np.abs(colour - colours[there]).max()
            if confidence[there] < measured:
                seen["perhaps"] += difference < perhaps
            elif far / depth[there] < 1 - same_depth:
                seen["through"] += 1
            elif far / depth[there] < 1 + same_depth:
                seen["alike" if difference < same_colour else "unlike"] += 1
        if seen["alike"]:
            return AGREES
        if seen["unlike"] >= fewest:
            return 0 if possible else CONTRADICTS
        possible = possible or seen["perhaps"] > seen["through"]
        z *= reach[2]
    return 0


@pytest.mark.parametrize("seed", range(3))
def test_the_kernel_judges_as_the_rule_says(seed: int) -> None:
    generator = np.random.default_rng(seed)
    views, cameras, geometry = wall(plate=0.3)
    with_somebody(views, geometry)
    assert geometry.confidence is not None
    given = geometry.depth, geometry.confidence, views.masks, views.images.permute(0, 2, 3, 1)
    depth, confidence, masks, colours = (np.ascontiguousarray(each) for each in given)
    depth = (depth * generator.uniform(0.9, 1.1, depth.shape)).astype(np.float32)
    masks = masks & (generator.random(masks.shape) > 0.1)
    confidence = np.where(generator.random(confidence.shape) > 0.2, confidence, 0).astype(np.float32)
    rows, columns = np.arange(2, HEIGHT, 9), np.arange(3, WIDTH, 11)
    view, others = 2, np.array([0, 1, 3, 4])
    x, y = torch.from_numpy(columns) + 0.5, torch.from_numpy(rows) + 0.5
    own = cameras[[view]]
    origin = own.centres[0].numpy()
    rays = own.unproject(torch.ones(1, len(rows), len(columns)), x, y)[0].numpy() - origin
    colour = np.ascontiguousarray(colours[view][np.ix_(rows, columns)])
    lenses = torch.stack(cameras.intrinsics, 1).numpy()
    limits = NEAREST_DEPTH, 0.05, 0.1, 0.06, 2.0, 0.5
    reach = 1.5, 6.0, 1.05
    maps = depth, confidence, masks, colours
    found = np.zeros((len(rows), len(columns)), np.int8)
    judge_pixels(found, rays, origin, reach, colour, others, cameras.w2c.numpy(), lenses, limits, *maps)
    w2c = cameras.w2c.double().numpy()
    expected = np.array(
        [
            [
                verdict_of(rays[r, c].astype(float), origin.astype(float), colour[r, c], reach, others, w2c,
                           lenses.astype(float), limits, *maps)
                for c in range(len(columns))
            ]
            for r in range(len(rows))
        ]
    )  # fmt: skip
    # A place on the border between two pixels may fall on either of them in float32.
    assert (found != expected).mean() < 0.02
    assert {0, AGREES, CONTRADICTS} <= set(found.ravel().tolist())
