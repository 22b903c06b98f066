"""Splitting Gaussians where renders and photos disagree."""

import math
from dataclasses import replace
from statistics import fmean

import pytest
import torch
from tto_scenes import wall

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import SH_0, Gaussians
from querysplat_cli.scene.rotations import quaternion_to_matrix
from querysplat_cli.scene.views import Views
from querysplat_cli.splat.render import render
from querysplat_cli.tto.densify import Share, densify, split
from querysplat_cli.tto.gaussians import optimise_gaussians
from querysplat_cli.tto.optimise import TtoResult
from querysplat_cli.tto.options import Callbacks, TtoSettings
from querysplat_cli.tto.policy import TTO_POLICY
from querysplat_cli.tto.rendering_loss import RenderingLoss

SIZE = 48


def cameras(count: int, shift: float = 0.0) -> Cameras:
    w2c = torch.eye(4).repeat(count, 1, 1)
    w2c[:, 0, 3] = torch.linspace(0.15, -0.15, count) + shift
    K = torch.tensor([[60.0, 0, SIZE / 2], [0, 60.0, SIZE / 2], [0, 0, 1]]).repeat(count, 1, 1)
    return Cameras(w2c, K, SIZE, SIZE)


def views(images: torch.Tensor) -> Views:
    count = len(images)
    masks = torch.ones(count, SIZE, SIZE, dtype=torch.bool)
    return Views(images, masks, tuple(f"{i}.png" for i in range(count)), ((SIZE, SIZE),) * count)


def ellipsoids(count: int, opacity: float) -> Gaussians:
    random = torch.Generator().manual_seed(3)
    return Gaussians(
        means=torch.randn(count, 3, generator=random, dtype=torch.float64),
        quats=torch.randn(count, 4, generator=random, dtype=torch.float64),
        scales=torch.rand(count, 3, generator=random, dtype=torch.float64) + 0.1,
        opacities=torch.full((count,), opacity, dtype=torch.float64),
        sh=torch.randn(count, 4, 3, generator=random, dtype=torch.float64),
    )


def covariance(some: Gaussians) -> torch.Tensor:
    axes = quaternion_to_matrix(some.quats) * some.scales[:, None]
    return axes @ axes.mT


def test_two_halves_have_the_centre_and_covariance_of_the_whole() -> None:
    whole = ellipsoids(20, 0.7)
    one, other = split(whole)
    torch.testing.assert_close((one.means + other.means) / 2, whole.means)
    aside = (one.means - other.means)[:, :, None] / 2
    torch.testing.assert_close(covariance(one) + aside @ aside.mT, covariance(whole))
    torch.testing.assert_close(one.sh, whole.sh)


@pytest.mark.parametrize("opacity", [0.01, 0.5, 0.99])
def test_two_halves_cover_as_much_as_the_whole(opacity: float) -> None:
    """The integral of α = 1 − (1 − α₁)(1 − α₂) over the plane that the longest axis lies in."""
    whole = replace(ellipsoids(1, opacity), quats=torch.tensor([[1.0, 0, 0, 0]]).double())
    whole = replace(whole, means=torch.zeros(1, 3).double(), scales=torch.tensor([[2.0, 1.0, 0.5]]).double())
    line = torch.linspace(-16, 16, 801, dtype=torch.float64)
    points = torch.stack(torch.meshgrid(line, line, indexing="ij"), -1)

    def alpha(some: Gaussians) -> torch.Tensor:
        return some.opacities * torch.exp(-0.5 * ((points - some.means[0, :2]) / some.scales[0, :2]).square().sum(-1))

    one, other = split(whole)
    together = 1 - (1 - alpha(one)) * (1 - alpha(other))
    assert float(together.sum() * (line[1] - line[0]) ** 2) == pytest.approx(opacity * 2 * math.pi * 2, rel=1e-9)


@pytest.mark.parametrize(("opacity", "most"), [(0.1, 0.05), (0.5, 0.09), (0.9, 0.19)])
def test_splitting_hardly_changes_the_picture(opacity: float, most: float) -> None:
    whole = Gaussians(
        means=torch.tensor([[0.0, 0.1, 2.0]]).double(),
        quats=torch.tensor([[1.0, 0.2, 0.1, 0.4]]).double(),
        scales=torch.tensor([[0.3, 0.15, 0.1]]).double(),
        opacities=torch.tensor([opacity]).double(),
        sh=torch.ones(1, 1, 3).double(),
    )
    one, other = split(whole)
    halves = Gaussians(*(torch.cat(pair) for pair in zip(one.tensors(), other.tensors(), strict=True)))
    before, after = (render(some, cameras(1).to(torch.float64)).colour for some in (whole, halves))
    assert float((after - before).norm() / before.norm()) < most


def test_the_share_is_the_error_under_each_gaussian() -> None:
    """Of one Gaussian alone: Σ α·|picture − photo|, where α is the renderer's."""
    one = Gaussians(
        means=torch.tensor([[0.0, 0.0, 2.0]]),
        quats=torch.tensor([[1.0, 0, 0, 0]]),
        scales=torch.full((1, 3), 0.2),
        opacities=torch.tensor([0.7]),
        sh=torch.full((1, 1, 3), -0.5 / SH_0),  # black
    )
    photos = torch.rand(2, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(0))
    confirmed = torch.rand(2, SIZE // 2, SIZE // 2, generator=torch.Generator().manual_seed(1)) < 0.3
    target = RenderingLoss(views(photos), cameras(2), confirmed=tuple(confirmed))
    alpha = render(one, cameras(2)).alpha
    share = Share.of(one, target)
    torch.testing.assert_close(share.weight, alpha.sum()[None], rtol=1e-4, atol=0)
    torch.testing.assert_close(share.error, (alpha * photos.mean(1)).sum()[None], rtol=1e-4, atol=0)
    inside = (~confirmed).repeat_interleave(2, 1).repeat_interleave(2, 2)
    torch.testing.assert_close(share.guessed, ((alpha * inside).sum() / alpha.sum())[None], rtol=1e-4, atol=0)


def test_padding_is_no_pixel_that_another_view_confirms() -> None:
    """A portrait photo beside a landscape one: what is guessed in all of both has a share of 1."""
    photos, half = views(torch.rand(2, 3, SIZE, SIZE)), SIZE // 2
    photos.masks[1, :, half:] = False
    guesses = torch.zeros(SIZE, SIZE, dtype=torch.bool), torch.zeros(SIZE, half, dtype=torch.bool)
    target = RenderingLoss(replace(photos, sizes=((SIZE, SIZE), (SIZE, half))), cameras(2), confirmed=guesses)
    share = Share.of(wall(6, size=0.8, opacity=0.8), target)
    torch.testing.assert_close(share.guessed, torch.ones(36), rtol=1e-4, atol=0)


def test_gaussians_of_a_wrong_colour_are_split() -> None:
    some = wall(6, size=0.8, opacity=0.8)
    target = RenderingLoss(views(render(some, cameras(3)).colour), cameras(3))
    wrong = torch.tensor([8, 21])
    sh = some.sh.clone()
    sh[wrong] += 1.0
    more = densify(replace(some, sh=sh), target, 38)
    assert len(more.gaussians) == 38
    assert more.origin.unique().equal(torch.arange(36))
    assert (more.origin.bincount() == 2).nonzero()[:, 0].equal(wrong)
    once = more.origin.bincount()[more.origin] == 1
    torch.testing.assert_close(more.gaussians.means[once], some.means[more.origin[once]])
    assert len(densify(some, target, 1000).gaussians) == 72
    assert len(densify(some, target, 5).gaussians) == 36


def test_faint_gaussians_of_guessed_pixels_go_and_others_are_split_instead() -> None:
    some = wall(6, size=0.8, opacity=0.8)
    faint = torch.tensor([0, 5, 30])  # corners of the wall: left, right, left
    opacities = some.opacities.clone()
    opacities[faint] = 0.03
    photos, right = views(render(some, cameras(3)).colour), torch.zeros(3, SIZE, SIZE, dtype=torch.bool)
    right[:, :, SIZE // 2 :] = True
    for confirmed, gone in ((right, [0, 30]), (~right, [5]), (None, [])):
        target = RenderingLoss(photos, cameras(3), confirmed=None if confirmed is None else tuple(confirmed))
        more = densify(replace(some, opacities=opacities), target, 40)
        assert len(more.gaussians) == 40
        assert sorted(set(range(36)) - set(more.origin.tolist())) == gone


def test_faint_gaussians_stay_where_they_are_what_the_photos_show() -> None:
    """As many faint layers, or as a faint Gaussian that is the whole background."""
    some = wall(6, size=0.8, opacity=0.05)
    photos, guesses = views(render(some, cameras(3)).colour), torch.zeros(3, SIZE, SIZE, dtype=torch.bool)
    target = RenderingLoss(photos, cameras(3), confirmed=tuple(guesses))
    weight = Share.of(some, target).weight / Share.of(some, target).weight.sum()
    more = densify(some, target, 40)
    gone = sorted(set(range(36)) - set(more.origin.tolist()))
    assert len(more.gaussians) == 40
    assert 0 < float(weight[gone].sum()) <= TTO_POLICY.faint_weight
    assert weight[gone].max() <= weight[more.origin].min()


def optimised(
    densify_to: int | None,
    steps: int = 90,
    lr: float = 0.1,
    confirmed: tuple[torch.Tensor, ...] | None = None,
    shade: float = 0.0,
    **options: object,
) -> TtoResult:
    """Sixteen Gaussians, of one grey and a shade of it, on photos of 144 colours."""
    photos = views(render(wall(12, size=0.8, opacity=0.8), cameras(4)).colour.clamp(0, 1))
    target = RenderingLoss(photos, cameras(4), confirmed=confirmed)
    grey = wall(4, size=0.8, opacity=0.8)
    return optimise_gaussians(
        replace(grey, sh=torch.full_like(grey.sh, shade)),
        target,
        TtoSettings(steps, lr),
        generator=torch.Generator().manual_seed(0),
        densify_to=densify_to,
        **options,  # type: ignore[arg-type]
    )


def test_a_coarse_scene_gains_in_views_that_were_not_optimised() -> None:
    """Coarse Gaussians on fine photos: with splitting, a view between the photos comes out better."""
    between = cameras(4, shift=0.05)
    truth = render(wall(12, size=0.8, opacity=0.8), between).colour.clamp(0, 1)
    plain, split_up = optimised(None), optimised(100)
    errors = [(render(each.gaussians, between).colour - truth).square().mean() for each in (plain, split_up)]
    assert errors[1] < 0.7 * errors[0]
    assert (plain.added, split_up.added) == (0, 84)
    assert [step.gaussians for step in split_up.history if step.gaussians > 16][-1] == 100 == len(split_up.gaussians)


@pytest.mark.parametrize("steps", [2, 3, 4])
def test_a_few_steps_reach_the_planned_count_as_well(steps: int) -> None:
    assert len(optimised(30, steps=steps).gaussians) == 30


def test_opacity_has_a_price_in_guessed_pixels_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """The price rises to a weight at which it shows; depth is never smoothed."""
    policy = "querysplat_cli.tto.{}.TTO_POLICY"
    monkeypatch.setattr(policy.format("rendering_loss"), replace(TTO_POLICY, smoothness=0.0))
    monkeypatch.setattr(policy.format("gaussians"), replace(TTO_POLICY, guessed_opacity=2.0))
    monkeypatch.setattr(policy.format("densify"), replace(TTO_POLICY, faint=0.0))
    left = torch.zeros(4, SIZE, SIZE, dtype=torch.bool)
    left[:, :, : SIZE // 2] = True
    free, all_confirmed = (optimised(100, confirmed=each) for each in (None, tuple(left | ~left)))
    assert all(a.equal(b) for a, b in zip(all_confirmed.gaussians.tensors(), free.gaussians.tensors(), strict=True))

    def opacities(confirmed: tuple[torch.Tensor, ...] | None) -> tuple[float, float]:
        """Of both sides, the guessed one first: means of eleven starts, as rounding alone moves either by a tenth."""
        shades = [0.0, *(sign * size for size in (1e-4, 3e-4, 1e-3, 3e-3, 1e-2) for sign in (1, -1))]
        scenes = [optimised(100, confirmed=confirmed, shade=shade).gaussians for shade in shades]
        guessed, sure = (
            fmean(float(s.opacities[s.means[:, 0] * side > 0.2].mean()) for s in scenes) for side in (1, -1)
        )
        return guessed, sure

    (free_guessed, free_sure), (guessed, sure) = opacities(None), opacities(tuple(left))
    assert free_guessed > 0.9 * free_sure
    assert guessed < 0.3 * sure


def test_splitting_is_repeatable() -> None:
    one, two = optimised(60, steps=20), optimised(60, steps=20)
    assert all(a.equal(b) for a, b in zip(one.gaussians.tensors(), two.gaussians.tensors(), strict=True))


@pytest.mark.parametrize("lr", [3.0, 1e30], ids=["too large", "overflowing"])
def test_steps_after_a_split_are_undone(lr: float) -> None:
    result = optimised(100, steps=60, lr=lr)
    assert result.undone > 0
    assert result.loss_after <= result.loss_before
    assert result.added == len(result.gaussians) - 16
    assert all(bool(part.isfinite().all()) for part in result.gaussians.tensors())


def test_interrupting_after_a_split_keeps_it() -> None:
    def interrupt(step: object) -> None:
        if getattr(step, "step", 0) == 40:
            raise KeyboardInterrupt

    result = optimised(100, callbacks=Callbacks(progress=interrupt))
    assert result.interrupted
    assert result.loss_after < result.loss_before
    assert 16 < len(result.gaussians) < 100
