"""Test-time optimisation on a small textured wall whose cameras and depth are known."""

import math
from dataclasses import replace

import pytest
import torch

from querysplat_cli.encoders.base import Geometry
from querysplat_cli.model.anchors import Anchors
from querysplat_cli.model.config import preset
from querysplat_cli.model.initialise import initial_model
from querysplat_cli.model.memories import Memories
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.queries.build import build_anchors
from querysplat_cli.queries.rendering_error import with_rendering_error
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.views import Views
from querysplat_cli.splat.render import render
from querysplat_cli.splat.similarity import photometric_loss
from querysplat_cli.tto.features import Start, gaussians_of, memories_of, optimise_memories
from querysplat_cli.tto.options import TtoSettings
from querysplat_cli.tto.rendering_loss import RenderingLoss

SIZE = 48
FOCAL = 60.0


@pytest.fixture(scope="module")
def wall() -> tuple[Views, Cameras]:
    """Five views of the plane z = 1, whose colour is a smooth function of position."""
    count = 5
    w2c = torch.eye(4).repeat(count, 1, 1)
    w2c[:, 0, 3] = torch.linspace(0.1, -0.1, count)
    K = torch.tensor([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1]]).repeat(count, 1, 1)
    pixels = (torch.arange(SIZE) + 0.5 - SIZE / 2) / FOCAL
    x = pixels[None, None, :] - w2c[:, 0, 3, None, None]
    y = pixels[None, :, None].expand(count, SIZE, SIZE)
    images = torch.stack(
        [0.5 + 0.4 * torch.sin(30 * x + 0 * y), 0.5 + 0.4 * torch.cos(25 * y + 5 * x), 0.3 + 0 * x + 0 * y], 1
    )
    masks = torch.ones(count, SIZE, SIZE, dtype=torch.bool)
    names = tuple(f"{i}.png" for i in range(count))
    return Views(images, masks, names, ((SIZE, SIZE),) * count), Cameras(w2c, K, SIZE, SIZE)


@pytest.fixture(scope="module")
def scene(wall: tuple[Views, Cameras]) -> tuple[QuerySplat, Memories, Anchors]:
    views, cameras = wall
    depth = torch.ones(len(views), SIZE, SIZE)
    anchors = with_rendering_error(build_anchors(views, cameras, Geometry(depth, depth, (), 6))[0], views, cameras)
    model = initial_model(preset("compact"), seed=0).requires_grad_(False)
    features = torch.randn(len(views), (SIZE // 6) ** 2, 12, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        return model, model.keys_and_values(model.embed((features,), views.images, cameras)), anchors


def test_the_gradient_summed_view_by_view_is_that_of_all_views_at_once(
    wall: tuple[Views, Cameras], scene: tuple[QuerySplat, Memories, Anchors]
) -> None:
    model, memories, anchors = scene
    with torch.no_grad():
        gaussians = model.decode(memories, anchors)
    together = render(gaussians := gaussians.map(lambda part: part.requires_grad_()), wall[1]).colour
    photometric_loss(together, wall[0].images, wall[0].masks).backward()
    summed = RenderingLoss(*wall).value_and_gradient(gaussians, [0, 1, 2, 3, 4])
    for name in ("means", "quats", "scales", "opacities", "sh"):
        one, two = getattr(gaussians, name).grad, getattr(summed.gradient, name)
        assert float(one.norm()) > 0
        assert float((one - two).norm()) <= 1e-5 * float(one.norm()), name


def test_features_of_a_model_whose_values_are_zero_are_optimised_through_the_residual_path(
    wall: tuple[Views, Cameras], scene: tuple[QuerySplat, Memories, Anchors]
) -> None:
    """Without a step the scene has the bits of that of keys and values; steps lower the loss as far as theirs."""
    model, memories, anchors = scene
    features = torch.randn(len(wall[0]), (SIZE // 6) ** 2, 12, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        tokens = model.embed((features,), wall[0].images, wall[1])
        plain = model.decode(memories, anchors)
    start = Start(tokens, anchors, origin=tokens)
    same = gaussians_of(model, start)
    assert all(
        torch.equal(getattr(plain, name), getattr(same, name)) for name in ("means", "scales", "opacities", "sh")
    )
    settings = TtoSettings(steps=12, lr=0.02, views_per_step=2)
    after = {
        name: optimise_memories(model, each, RenderingLoss(*wall), settings, generator=torch.Generator().manual_seed(1))
        for name, each in (("kv", Start(memories, anchors)), ("features", start))
    }
    falls = {name: result.loss_before - result.loss_after for name, result in after.items()}
    assert falls["features"] > 0.8 * falls["kv"] > 0
    moved = memories_of(model, replace(start, variables=after["features"].variables))
    torch.testing.assert_close(model.decode(moved, anchors).means, after["features"].gaussians.means)


def test_the_loss_falls_and_the_network_stays_frozen(
    wall: tuple[Views, Cameras], scene: tuple[QuerySplat, Memories, Anchors]
) -> None:
    model, memories, anchors = scene
    weights = [parameter.clone() for parameter in model.parameters()]
    settings = TtoSettings(steps=12, lr=0.02, views_per_step=2)
    result = optimise_memories(
        model, Start(memories, anchors), RenderingLoss(*wall), settings, generator=torch.Generator().manual_seed(1)
    )
    assert result.loss_after < 0.8 * result.loss_before
    assert len(result.history) == 12
    assert all(torch.equal(a, b) for a, b in zip(weights, model.parameters(), strict=True))


def test_the_same_seed_gives_the_same_memories(
    wall: tuple[Views, Cameras], scene: tuple[QuerySplat, Memories, Anchors]
) -> None:
    model, memories, anchors = scene

    def run() -> Memories:
        generator = torch.Generator().manual_seed(3)
        start, settings = Start(memories, anchors), TtoSettings(3, 0.02, 2)
        return optimise_memories(model, start, RenderingLoss(*wall), settings, generator=generator).variables

    one, two = run(), run()
    assert torch.equal(one.geometry_values, two.geometry_values)
    assert torch.equal(one.appearance_values, two.appearance_values)


@pytest.mark.parametrize("rate", [100.0, 1e30], ids=["far too large", "overflowing"])
def test_a_rate_that_is_far_too_large_does_no_harm(
    rate: float, wall: tuple[Views, Cameras], scene: tuple[QuerySplat, Memories, Anchors]
) -> None:
    model, memories, anchors = scene
    target, generator = RenderingLoss(*wall), torch.Generator().manual_seed(0)
    result = optimise_memories(model, Start(memories, anchors), target, TtoSettings(5, rate), generator=generator)
    assert math.isfinite(result.loss_after)
    assert result.loss_after <= result.loss_before
