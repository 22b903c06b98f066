"""Colour transforms of photos: fitted to what is known, left alone where photos agree, and honest about alpha."""

from dataclasses import replace

import pytest
import torch
from tto_scenes import wall

from querysplat_cli.encoders.base import Geometry
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.exposures import Exposures
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.views import Views
from querysplat_cli.splat.conventions import MID_GREY
from querysplat_cli.splat.render import render
from querysplat_cli.tto import exposure_fit, exposure_refit
from querysplat_cli.tto.exposure_fit import compare_photos, fit_samples
from querysplat_cli.tto.exposure_policy import EXPOSURE_POLICY
from querysplat_cli.tto.exposure_refit import RefittedExposures
from querysplat_cli.tto.exposure_samples import ColourSamples
from querysplat_cli.tto.gaussians import optimise_gaussians
from querysplat_cli.tto.options import Callbacks, TtoSettings
from querysplat_cli.tto.rendering_loss import RenderingLoss

SIZE, VIEWS = 64, 4
SH_0 = 0.28209479177387814


def changes(seed: int = 0) -> Exposures:
    """Gains of about ± 20 %, some mixing of channels, and small offsets; their mean is the identity."""
    generator = torch.Generator().manual_seed(seed)
    matrices = Exposures.identity(VIEWS).matrices
    gains = 1 + 0.2 * torch.randn(VIEWS, 1, 1, generator=generator, dtype=torch.float64)
    noise = 0.02 * torch.randn(VIEWS, 3, 4, generator=generator, dtype=torch.float64)
    return Exposures(gains * matrices + noise).with_identity_mean()


def observed(exposures: Exposures, points: int = 300) -> ColourSamples:
    """Every point in every view, without noise."""
    colours = torch.rand(points, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    point = torch.arange(points).repeat(VIEWS)
    view = torch.arange(VIEWS).repeat_interleave(points)
    shown = torch.einsum("vij,pj->vpi", exposures.matrices[:, :, :3], colours) + exposures.matrices[:, None, :, 3]
    return ColourSamples(point, view, shown.flatten(0, 1))


@pytest.fixture
def no_ridge(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (exposure_fit, exposure_refit):
        monkeypatch.setattr(module, "EXPOSURE_POLICY", replace(EXPOSURE_POLICY, ridge=0.0))


@pytest.mark.usefixtures("no_ridge")
def test_known_changes_are_recovered() -> None:
    found, _ = fit_samples(observed(changes()), VIEWS)
    torch.testing.assert_close(found.matrices, changes().matrices, atol=1e-3, rtol=0)


@pytest.mark.usefixtures("no_ridge")
def test_wrong_matches_hardly_matter() -> None:
    samples = observed(changes())
    wrong = torch.rand(len(samples), generator=torch.Generator().manual_seed(2)) < 0.1
    random = torch.rand(len(samples), 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    found, _ = fit_samples(replace(samples, colour=torch.where(wrong[:, None], random, samples.colour)), VIEWS)
    torch.testing.assert_close(found.matrices, changes().matrices, atol=0.04, rtol=0)


def test_the_ridge_pulls_what_no_colour_shows_to_the_identity() -> None:
    """Points of one grey show a gain or an offset, but nothing about the channels' mixing."""
    samples = observed(changes())
    grey = samples.colour.mean(1, keepdim=True).expand(-1, 3)
    found, _ = fit_samples(replace(samples, colour=grey.contiguous()), VIEWS)
    sums = found.matrices[:, :, :3].sum(2)
    assert float((sums - sums.mean(1, keepdim=True)).abs().max()) < 1e-9
    assert float((found.matrices - Exposures.identity(VIEWS).matrices).abs().max()) < 0.4


def test_the_mean_is_the_identity() -> None:
    for exposures in (changes(), fit_samples(observed(changes(5)), VIEWS)[0]):
        torch.testing.assert_close(exposures.matrices.mean(0), torch.eye(3, 4, dtype=torch.float64))


def test_a_view_without_observations_keeps_the_identity() -> None:
    samples = observed(changes())
    seen = samples.view < VIEWS - 1
    fewer = ColourSamples(samples.point[seen], samples.view[seen], samples.colour[seen])
    found, _ = fit_samples(fewer, VIEWS)
    torch.testing.assert_close(found.matrices[-1], torch.eye(3, 4, dtype=torch.float64))
    torch.testing.assert_close(found.matrices.mean(0), torch.eye(3, 4, dtype=torch.float64))


def cameras() -> Cameras:
    w2c = torch.eye(4).repeat(VIEWS, 1, 1)
    w2c[:, 0, 3] = torch.linspace(0.3, -0.3, VIEWS)
    K = torch.tensor([[1.25 * SIZE, 0, SIZE / 2], [0, 1.25 * SIZE, SIZE / 2], [0, 0, 1]]).repeat(VIEWS, 1, 1)
    return Cameras(w2c, K, SIZE, SIZE)


def coloured_wall() -> Gaussians:
    """Opaque, in colours from 0.25 to 0.75, so that no transform below clips them."""
    some = wall(12, size=1.2, opacity=0.97)
    return replace(some, sh=some.sh * 0.25 / SH_0)


def photos(exposures: Exposures | None = None) -> Views:
    """Of the wall over grey."""
    drawn = render(coloured_wall(), cameras())
    images = drawn.over(torch.full((3,), MID_GREY))
    if exposures:
        refitted = RefittedExposures(exposures)
        images = torch.cat(
            [
                refitted.exposed(render(coloured_wall(), cameras()[[view]]), view).over(torch.full((3,), MID_GREY))
                for view in range(VIEWS)
            ]
        )
    return Views(
        images.clamp(0, 1), torch.ones(VIEWS, SIZE, SIZE, dtype=torch.bool), ("a", "b", "c", "d"), ((SIZE, SIZE),) * 4
    )


def flat_geometry() -> Geometry:
    depth = torch.full((VIEWS, SIZE, SIZE), 2.0)
    return Geometry(depth, torch.ones_like(depth), (), 8)


def test_photos_that_agree_have_the_identity() -> None:
    found = compare_photos(photos(), cameras(), flat_geometry())
    assert found.agree
    assert found.disagreement < 0.01
    torch.testing.assert_close(found.exposures.matrices, Exposures.identity(VIEWS).matrices, atol=0.03, rtol=0)


def test_photos_without_depth_to_compare_them_by_agree() -> None:
    unsure = replace(flat_geometry(), confidence=torch.zeros(VIEWS, SIZE, SIZE))
    found = compare_photos(photos(changes()), cameras(), unsure)
    assert found.agree
    torch.testing.assert_close(found.exposures.matrices, Exposures.identity(VIEWS).matrices)


def test_noise_is_no_disagreement(monkeypatch: pytest.MonkeyPatch) -> None:
    """Errors of the transforms, which few noisy points leave, do not count as differences between photos."""
    found = []
    for seed in range(8):
        samples = observed(Exposures.identity(VIEWS), points=60)
        noise = 0.2 * torch.randn(len(samples), 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        noisy = replace(samples, colour=samples.colour + noise)
        monkeypatch.setattr(exposure_fit, "sample_colours", lambda *_, noisy=noisy: noisy)
        colours = compare_photos(photos(), cameras(), flat_geometry())
        errors = colours.exposures.matrices - Exposures.identity(VIEWS).matrices
        assert float(errors.square().mean().sqrt()) > 0.04
        found.append(colours.disagreement)
    assert sum(found) / len(found) < 0.03
    assert max(found) < EXPOSURE_POLICY.disagreement


@pytest.mark.usefixtures("no_ridge")
def test_photos_that_differ_are_found() -> None:
    found = compare_photos(photos(changes()), cameras(), flat_geometry())
    assert not found.agree
    # Single coefficients depend on which colours there are; what they do to these colours does not.
    colours = torch.rand(50, 3, generator=torch.Generator().manual_seed(4), dtype=torch.float64) * 0.4 + 0.3
    shown = [
        torch.einsum("vij,pj->vpi", one.matrices[:, :, :3], colours) + one.matrices[:, None, :, 3]
        for one in (found.exposures, changes())
    ]
    torch.testing.assert_close(*shown, atol=0.03, rtol=0)


def test_a_difference_that_follows_the_cameras_is_left_to_the_scene() -> None:
    """The gain changes by the same amount from each photo to the next, or by turns."""
    shades = torch.tensor([-1.5, -0.5, 0.5, 1.5], dtype=torch.float64)
    turns = torch.tensor([-1.0, 1.0, -1.0, 1.0], dtype=torch.float64)
    spread = {}
    for name, gains in (("place", shades / shades.norm()), ("turns", turns / turns.norm())):
        exposures = Exposures((1 + 0.15 * gains)[:, None, None] * Exposures.identity(VIEWS).matrices)
        spread[name] = compare_photos(photos(exposures), cameras(), flat_geometry()).disagreement
    assert spread["place"] < 0.6 * spread["turns"]


def test_photos_are_brought_to_the_scene_s_colours() -> None:
    exposures = changes()
    alike, plain = exposures.removed_from(photos(exposures)), photos()
    opaque = render(coloured_wall(), cameras()).alpha > 0.99
    assert opaque.float().mean() > 0.2
    error = (alike.images - plain.images).abs().amax(1)[opaque]
    assert float(error.max()) < 0.02


def test_large_photos_are_brought_to_the_scene_s_colours_too() -> None:
    """Their 8 bits stay 8 bits."""
    exposures = changes()
    taken = photos(exposures)
    eight = replace(taken, images=(taken.images * 255).round().to(torch.uint8))
    found = exposures.removed_from(eight)
    assert found.images.dtype == torch.uint8
    assert float((found.images / 255 - exposures.removed_from(taken).images).abs().max()) < 2 / 255


def test_transformed_renders_are_renders_of_transformed_gaussians() -> None:
    """Over any background, also where the scene is half transparent."""
    thin, view = replace(coloured_wall(), opacities=torch.full((144,), 0.4)), 1
    matrix = changes().matrices[view].float()
    colours = 0.5 + SH_0 * thin.sh[:, 0]
    moved = replace(thin, sh=((colours @ matrix[:, :3].T + matrix[:, 3] - 0.5) / SH_0)[:, None])
    background = torch.tensor([0.9, 0.1, 0.4])
    found = RefittedExposures(changes()).exposed(render(thin, cameras()[[view]]), view)
    expected = render(moved, cameras()[[view]])
    torch.testing.assert_close(found.over(background), expected.over(background), atol=1e-4, rtol=0)
    torch.testing.assert_close(found.alpha, expected.alpha)


@pytest.mark.usefixtures("no_ridge")
def test_refitting_finds_the_transforms_of_a_scene_that_is_right() -> None:
    target, views = RefittedExposures(Exposures.identity(VIEWS)), photos(changes())
    for _ in range(12):
        for view in range(VIEWS):
            drawn = render(coloured_wall(), cameras()[[view]])
            target.refit(view, drawn, views.picture(view), views.masks[view])
    drawn = render(coloured_wall(), cameras())
    for view in range(VIEWS):
        shown = target.exposed(render(coloured_wall(), cameras()[[view]]), view).over(torch.full((3,), MID_GREY))
        opaque = drawn.alpha[view] > 0.99
        assert float((shown[0] - views.images[view]).abs().amax(0)[opaque].max()) < 0.02
    torch.testing.assert_close(target.current.matrices.mean(0), torch.eye(3, 4, dtype=torch.float64))


def test_what_the_scene_does_not_cover_does_not_count() -> None:
    empty, views = replace(coloured_wall(), opacities=torch.full((144,), 1e-6)), photos(changes())
    target = RefittedExposures(Exposures.identity(VIEWS))
    for _ in range(5):
        target.refit(0, render(empty, cameras()[[0]]), views.picture(0), views.masks[0])
    torch.testing.assert_close(target.current.matrices, Exposures.identity(VIEWS).matrices, atol=1e-3, rtol=0)


def target(exposures: Exposures | None) -> RenderingLoss:
    return RenderingLoss.for_solid_scenes(
        photos(changes()),
        cameras(),
        torch.Generator().manual_seed(0),
        RefittedExposures(exposures) if exposures else None,
    )


def test_optimisation_with_transforms_finds_the_true_colours() -> None:
    dull = replace(coloured_wall(), sh=coloured_wall().sh * 0.3)
    errors = {}
    for name, start in (("without", None), ("with", Exposures.identity(VIEWS))):
        loss = target(start)
        result = optimise_gaussians(dull, loss, TtoSettings(40, 0.05), generator=torch.Generator().manual_seed(0))
        truth, found = (render(some, cameras()[[1]]).colour for some in (coloured_wall(), result.gaussians))
        errors[name] = float((truth - found).square().mean().sqrt())
        if loss.exposures:
            torch.testing.assert_close(loss.exposures.current.matrices.mean(0), torch.eye(3, 4, dtype=torch.float64))
    assert errors["with"] < 0.75 * errors["without"]


def test_transforms_go_back_with_a_scene_that_became_no_better() -> None:
    loss = target(changes())
    result = optimise_gaussians(coloured_wall(), loss, TtoSettings(3, 50.0), generator=torch.Generator().manual_seed(0))
    assert result.loss_after == result.loss_before
    assert loss.exposures
    assert torch.equal(loss.exposures.current.matrices, changes().matrices)


def test_transforms_do_not_follow_a_step_that_is_undone() -> None:
    """Where the scene stands again, they are what a second look at it makes of them."""
    found = []
    for steps, rate in ((3, 50.0), (2, 0.0)):
        loss = target(Exposures.identity(VIEWS))
        assert loss.exposures
        seen: list[Exposures] = []
        callbacks = Callbacks(look=lambda _, seen=seen, now=loss.exposures: seen.append(now.current))
        generator = torch.Generator().manual_seed(0)
        settings = TtoSettings(steps, rate)
        result = optimise_gaussians(coloured_wall(), loss, settings, generator=generator, callbacks=callbacks)
        assert (len(seen), result.undone) == (2, steps - 2)
        found.append(seen[1].matrices)
    torch.testing.assert_close(*found, atol=1e-6, rtol=0)
