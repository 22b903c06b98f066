"""Pruning of Gaussians, of SH bands and of near-duplicate views."""

import math
from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from querysplat_cli.prune.bands import without_idle_bands
from querysplat_cli.prune.gaussians import importance, prune, target_count
from querysplat_cli.prune.policy import PRUNE_POLICY
from querysplat_cli.prune.views import near_duplicates
from querysplat_cli.runtime.sequences import evenly_spaced
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import SH_0, Gaussians
from querysplat_cli.scene.views import Views
from querysplat_cli.splat.render import render
from querysplat_cli.tto.gaussians import optimise_gaussians
from querysplat_cli.tto.options import Callbacks, TtoSettings
from querysplat_cli.tto.rendering_loss import RenderingLoss

SIZE = 32


def cameras(*sideways: float) -> Cameras:
    w2c = torch.eye(4).repeat(len(sideways), 1, 1)
    w2c[:, 0, 3] = -torch.tensor(sideways)
    K = torch.tensor([[40.0, 0, SIZE / 2], [0, 40.0, SIZE / 2], [0, 0, 1]]).repeat(len(sideways), 1, 1)
    return Cameras(w2c, K, SIZE, SIZE)


def wall_and_hidden(hidden: int = 50) -> Gaussians:
    """A wall of 144 opaque Gaussians near z = 2, each at its own depth, and `hidden` ones behind the wall."""
    steps = torch.linspace(-1.1, 1.1, 12)
    depth = torch.linspace(1.9, 2.1, 144)[torch.randperm(144, generator=torch.Generator().manual_seed(5))]
    wall = torch.stack([*torch.meshgrid(steps, steps, indexing="xy"), depth.view(12, 12)], -1).reshape(-1, 3)
    behind = torch.rand(hidden, 3, generator=torch.Generator().manual_seed(0)) * 0.5 + torch.tensor([-0.2, -0.2, 4.0])
    count = len(wall) + hidden
    random = torch.Generator().manual_seed(1)
    return Gaussians(
        means=torch.cat([wall, behind]),
        quats=torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        scales=torch.full((count, 3), 0.15),
        opacities=torch.full((count,), 0.99),
        sh=torch.randn(count, 4, 3, generator=random) * torch.tensor([1.0, 0, 0, 0])[:, None],
    )


def photos(gaussians: Gaussians, views: Cameras) -> RenderingLoss:
    """Photos of the Gaussians, with a little noise, so that PSNR is finite."""
    images = render(gaussians, views).colour
    images = (images + 0.01 * torch.randn(images.shape, generator=torch.Generator().manual_seed(2))).clamp(0, 1)
    names = tuple(f"{i}.png" for i in range(len(views)))
    masks = torch.ones(len(views), SIZE, SIZE, dtype=torch.bool)
    return RenderingLoss(Views(images, masks, names, ((SIZE, SIZE),) * len(views)), views)


def test_importance_is_blending_weight_times_change_of_the_render() -> None:
    """Compared with blending weights and with renders without each Gaussian, over enough views for signs to average."""
    scene, views = wall_and_hidden(0)[::9], cameras(*torch.linspace(-0.2, 0.2, 200).tolist())
    scene = replace(scene, opacities=torch.linspace(0.2, 0.9, len(scene)))
    margin = math.ceil(SIZE / 10)
    wider = replace(views, K=views.K.clone(), height=SIZE + 2 * margin, width=SIZE + 2 * margin)
    wider.K[:, :2, 2] += margin
    bright = replace(scene, sh=scene.sh.clone())
    bright.sh[:, 0] += 0.5 / SH_0
    whole, black = render(bright, wider).colour, torch.full_like(scene.sh, 0)
    black[:, 0] = -0.5 / SH_0
    found = importance(scene, views)
    for each in range(len(scene)):
        others = torch.arange(len(scene)) != each
        gone = (whole - render(bright[others], wider).colour).square().sum()
        white = black.clone()
        white[each, 0] = 0.5 / SH_0
        weight = render(replace(scene, sh=white), wider).colour[:, 0].sum()
        expected = weight * (gone.sqrt() + PRUNE_POLICY.hidden_change * weight)
        assert found[each] == pytest.approx(float(expected), rel=0.2)


def test_a_gaussian_counts_whatever_its_red_is() -> None:
    """A red that is below zero in the picture has no gradient, but green and blue are seen."""
    scene, views = wall_and_hidden(0)[::9], cameras(-0.1, 0.0, 0.1)
    cyan = scene.sh.clone()
    cyan[0, 0] = torch.tensor([-1.5, 0.5, 0.5]) / SH_0
    assert float(importance(replace(scene, sh=cyan), views)[0]) > 0.3 * float(importance(scene, views)[0])


def test_gaussians_that_no_photo_shows_are_pruned() -> None:
    scene, views = wall_and_hidden(144), cameras(-0.1, 0.0, 0.1)
    target = photos(scene, views)
    pruned = prune(scene, views, "auto", lambda some: target.psnr(some, [0, 1, 2]), math.inf)
    assert int(pruned.kept[:144].sum()) >= 140
    assert int(pruned.kept.sum()) == 144
    assert pruned.psnr_after == pytest.approx(target.psnr(scene[pruned.kept], [0, 1, 2]))
    assert pruned.psnr_before == pytest.approx(target.psnr(scene, [0, 1, 2]))


def test_of_two_gaussians_that_coincide_the_second_is_pruned_first() -> None:
    wall, views = wall_and_hidden(0), cameras(*torch.linspace(-0.1, 0.1, 50).tolist())
    apart = replace(wall, scales=torch.full((144, 3), 0.04))
    doubled = Gaussians(*(torch.cat([getattr(apart, each.name)] * 2) for each in fields(apart)))
    first, second = importance(doubled, views).view(2, -1)
    assert (first > second).all()


def test_a_number_keeps_those_of_most_importance() -> None:
    scene, views = wall_and_hidden(), cameras(-0.1, 0.0, 0.1)
    pruned = prune(scene, views, 100, lambda some: float(len(some)), 0.0)
    assert int(pruned.kept.sum()) == 100
    found = importance(scene, views)
    assert found[pruned.kept].min() >= found[~pruned.kept].max()
    assert pruned.psnr_before - pruned.psnr_after == 94
    assert prune(scene, views, 1000, lambda some: 0.0, 0.0).kept.all()


@pytest.mark.parametrize("steps", [9.0, 11.0])
def test_no_gaussian_is_pruned_where_the_steps_left_cannot_make_up_for_it(steps: float) -> None:
    scene, views = wall_and_hidden(), cameras(-0.1, 0.0, 0.1)
    pruned = prune(scene, views, "auto", lambda some: 30.0 if len(some) == len(scene) else 29.0, steps)
    assert pruned.kept.all() == (steps == 9)
    assert pruned.psnr_after == (30 if steps == 9 else 29)


def test_half_of_the_gaussians_stay_unless_there_are_few_for_the_pixels() -> None:
    views = cameras(0.0, 0.1, 0.2)  # 3 · 32 · 32 = 3072 pixels
    assert target_count(1000, "auto", views) == 500
    assert target_count(50, "auto", views) == 30
    assert target_count(20, "auto", views) == 20
    assert target_count(1000, "off", views) == 1000
    assert target_count(1000, 400, views) == 400
    assert target_count(300, 400, views) == 300


def test_optimisation_continues_with_the_gaussians_that_stay() -> None:
    scene, views = wall_and_hidden(), cameras(-0.1, 0.0, 0.1)
    result = optimise_gaussians(
        scene,
        photos(replace(scene, sh=0.5 * scene.sh), views),
        TtoSettings(steps=10, lr=0.002),
        generator=torch.Generator().manual_seed(0),
        callbacks=Callbacks(prune=lambda some, _, steps: prune(some, views, 150, lambda each: 0.0, steps)),
    )
    assert result.loss_after < result.loss_before
    assert {(step.step < 4, step.gaussians) for step in result.history} == {(True, 194), (False, 150)}
    assert result.pruned is not None
    assert len(result.gaussians) == int(result.pruned.kept.sum()) == 150


def test_steps_after_a_costly_pruning_are_not_taken_for_failures() -> None:
    scene, views = wall_and_hidden(), cameras(-0.1, 0.0, 0.1)
    result = optimise_gaussians(
        scene,
        photos(scene, views),
        TtoSettings(steps=10, lr=0.002),
        generator=torch.Generator().manual_seed(0),
        callbacks=Callbacks(prune=lambda some, _, steps: prune(some, views, 100, lambda each: 0.0, steps)),
    )
    assert [step.gaussians for step in result.history[-5:]] == [100] * 5
    assert len(result.gaussians) == 194, "a state that is worse than the start is not kept"


@pytest.mark.parametrize("size", [0.0, 1.0])
def test_bands_are_left_out_where_colours_do_not_depend_on_the_direction(size: float) -> None:
    scene, views = wall_and_hidden(), cameras(-0.3, 0.3)
    random = torch.Generator().manual_seed(3)
    scene = replace(scene, sh=scene.sh + size * torch.randn(scene.sh.shape, generator=random))
    target = photos(scene, views)
    fewer, idle = without_idle_bands(scene, lambda some: target.psnr(some, [0, 1]))
    if size:
        assert idle is None
        assert fewer is scene
    else:
        assert fewer.sh_degree == 0
        assert idle is not None
        assert idle.count == 3
        assert math.isclose(idle.psnr_lost, 0, abs_tol=1e-4)


def test_views_from_one_place_are_duplicates_and_others_are_not() -> None:
    points = torch.rand(40, 3, generator=torch.Generator().manual_seed(4)) + torch.tensor([-0.5, -0.5, 2.0])
    # 40 px · 0.002 / 2.5 = 0.03 px, 3.2 px: of 32 pixels, 0.128 are the limit.
    views = cameras(0.0, 0.002, 0.2, 0.202, 0.4)
    everything = (torch.arange(40),) * 5
    assert near_duplicates(views, points, everything) == {1: 0, 3: 2}
    half = (torch.arange(40), torch.arange(25, 40), *everything[2:])
    assert near_duplicates(views, points, half) == {1: 0, 3: 2}
    apart = (torch.arange(20), torch.arange(10, 40), *everything[2:])
    assert 1 not in near_duplicates(views, points, apart)
    assert near_duplicates(views, torch.zeros(0, 3), (torch.zeros(0, dtype=torch.int64),) * 5) == {}


@given(st.integers(1, 60), st.integers(1, 60))
def test_evenly_spaced_items_include_both_ends(items: int, count: int) -> None:
    kept = evenly_spaced(range(items), count)
    assert len(kept) == len(set(kept)) == min(items, count)
    assert kept == sorted(kept)
    if count > 1:
        assert kept[0] == 0
        assert kept[-1] == items - 1
        gaps = np.diff(kept)
        assert len(gaps) == 0 or gaps.max() - gaps.min() <= 1
