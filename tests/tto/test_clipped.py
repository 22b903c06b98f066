"""White of a long exposure says that the scene is at least so bright, and what is masked says nothing of colours."""

import pytest
import torch
from tto_scenes import wall

from querysplat_cli.encoders.base import Geometry
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.exposures import Exposures
from querysplat_cli.scene.views import Views
from querysplat_cli.splat.conventions import MID_GREY
from querysplat_cli.splat.render import render
from querysplat_cli.tto.densify import Share
from querysplat_cli.tto.exposure_refit import RefittedExposures
from querysplat_cli.tto.exposure_samples import sample_colours
from querysplat_cli.tto.rendering_loss import RenderingLoss

SIZE = 48


def facing(places: list[float]) -> Cameras:
    """Cameras at these x that look along +z."""
    w2c = torch.eye(4).repeat(len(places), 1, 1)
    w2c[:, 0, 3] = -torch.tensor(places)
    K = torch.tensor([[60.0, 0, SIZE / 2], [0, 60.0, SIZE / 2], [0, 0, 1]]).repeat(len(places), 1, 1)
    return Cameras(w2c, K, SIZE, SIZE)


def photos(images: torch.Tensor, masks: torch.Tensor | None = None) -> Views:
    shown = torch.ones(len(images), SIZE, SIZE, dtype=torch.bool) if masks is None else masks
    return Views(images, shown, tuple(f"{i}.png" for i in range(len(images))), ((SIZE, SIZE),) * len(images))


@pytest.mark.parametrize("halved", [0.0, 1.0])
@pytest.mark.parametrize(("gain", "offset"), [(1.4, 0.0), (1.0, -0.9)], ids=["white", "black"])
def test_a_clipped_photo_of_the_true_scene_changes_nothing(
    gain: float, offset: float, halved: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The loss on the white photo was 0.065, and darkened the scene."""
    scene, cameras = wall(12, size=1.2, opacity=0.99), facing([0.0, 0.1])
    scene.sh[:, 0] = (0.8 - 0.5) / 0.28209479177387814
    matrices = Exposures.identity(2).matrices
    matrices[0, :, :3] *= gain
    matrices[0, :, 3] = offset
    exposures = RefittedExposures(Exposures(matrices))
    monkeypatch.setattr(exposures, "refit", lambda *given: None)  # they are the true ones
    exact = [
        exposures.exposed(render(scene, cameras[[view]]), view).over(torch.full((3,), MID_GREY)) for view in (0, 1)
    ]
    middle = torch.zeros(2, SIZE, SIZE, dtype=torch.bool)
    middle[:, 16:32, 16:32] = True  # where the scene is opaque, whatever lies behind it
    target = RenderingLoss(
        photos(torch.cat(exact).clamp(0, 1), middle),
        cameras,
        torch.full((3,), MID_GREY),
        backgrounds=torch.Generator().manual_seed(0) if halved else None,
        exposures=exposures,
        halved=halved,
    )
    assert target.value(scene, [0]) < 1e-3
    assert float(target.value_and_gradient(scene, [0]).gradient.sh.abs().sum()) < 1e-3


def test_masked_pixels_are_no_colours_of_the_photo() -> None:
    """A fine mask over grey photos: the black under it made one of them darker."""
    masks = torch.ones(2, SIZE, SIZE, dtype=torch.bool)
    masks[0, ::4] = False
    views = photos(torch.full((2, 3, SIZE, SIZE), 0.6) * masks[:, None], masks)
    flat = Geometry(torch.full((2, SIZE, SIZE), 3.0), torch.ones(2, SIZE, SIZE), (), 14, ())
    found = sample_colours(views, facing([0.0, 0.1]), flat)
    assert len(found)
    torch.testing.assert_close(found.colour, torch.full_like(found.colour, 0.6), atol=1e-5, rtol=0)


def test_clipped_places_are_not_split() -> None:
    """The loss has no error there; splitting counted the whole distance to white."""
    scene, cameras = wall(12, size=1.2, opacity=0.99), facing([0.0])
    scene.sh[:, 0] = (0.8 - 0.5) / 0.28209479177387814
    twice = Exposures(2 * torch.eye(3, 4)[None].double())
    target = RenderingLoss(photos(torch.ones(1, 3, SIZE, SIZE)), cameras, exposures=RefittedExposures(twice))
    assert target.value(scene, [0]) < 1e-3
    assert Share.of(scene, target).error.max() < 1e-3
