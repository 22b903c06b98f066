"""Gaussians that no photo shows may not hide what photos show."""

import torch

from querysplat_cli.prune.hiding import hiding
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians, joined
from querysplat_cli.scene.views import Views
from querysplat_cli.splat.render import render
from querysplat_cli.tto.pruning import pruning_to
from querysplat_cli.tto.rendering_loss import RenderingLoss

SIZE = 64
FOCAL = 100.0  # pixels: a photo shows 0.32 units to each side at depth 1


def cameras_at(*places: float) -> Cameras:
    """Cameras on the x axis, which look along z."""
    w2c = torch.eye(4).repeat(len(places), 1, 1)
    w2c[:, 0, 3] = -torch.tensor(places)
    K = torch.tensor([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1]]).repeat(len(places), 1, 1)
    return Cameras(w2c, K, SIZE, SIZE)


def discs(*means: tuple[float, float, float], scale: float) -> Gaussians:
    count = len(means)
    quats = torch.tensor([1.0, 0, 0, 0]).repeat(count, 1)
    return Gaussians(
        torch.tensor(means), quats, torch.full((count, 3), scale), torch.full((count,), 0.9), torch.zeros(count, 1, 3)
    )


def wall() -> Gaussians:
    """At depth 10, over what two photos from −1 and 1 show there, and what a camera between them sees."""
    columns, rows = torch.linspace(-4.1, 4.1, 25).tolist(), torch.linspace(-3.1, 3.1, 19).tolist()
    return discs(*[(x, y, 10.0) for x in columns for y in rows], scale=0.3)


FOG = discs((0.0, 0.0, 1.0), scale=0.05)
"""Between two cameras at −1 and 1, outside both photos."""


def test_fog_between_two_photos_is_found_alone():
    seen = discs((-1.0, 0.0, 1.0), scale=0.05)  # as near, but in one of the photos
    aside = discs((0.0, 6.0, 1.0), scale=0.05)  # outside all pictures
    found = hiding(joined(FOG, seen, aside, wall()), cameras_at(-1, 1))
    assert found.nonzero().flatten().tolist() == [0]


def test_what_stands_where_photos_show_nothing_stays():
    assert not hiding(joined(FOG, discs((-1.0, 0.0, 10.0), scale=0.1)), cameras_at(-1, 1)).any()


def test_fog_that_one_photo_alone_shows_is_found():
    alone = discs((-0.75, 0.0, 3.0), scale=0.05)  # in the photo at −1, and seen from 0
    both = discs((0.0, 0.0, 4.0), scale=0.05)  # in both photos
    found = hiding(joined(alone, both, wall()), cameras_at(-1, 1))
    assert found.nonzero().flatten().tolist() == [0]


def test_what_is_behind_stays():
    behind = discs((0.0, 0.0, 20.0), scale=0.05)
    assert not hiding(joined(behind, wall()), cameras_at(-1, 1)).any()


def test_what_a_photo_shows_as_well_can_be_spared():
    alone = discs((-0.75, 0.0, 3.0), scale=0.05)  # as large in the photo at −1 as from 0
    scene, cameras = joined(FOG, alone, wall()), cameras_at(-1, 1)
    assert hiding(scene, cameras).nonzero().flatten().tolist() == [0, 1]
    assert hiding(scene, cameras, harm=3.0).nonzero().flatten().tolist() == [0]


def test_padding_is_no_photo():
    """On the canvas, both photos show the fog. In fact it is beside the photo at −1, and only the other shows it."""
    fog, narrow = discs((-0.2, 0.0, 4.0), scale=0.05), [(SIZE, 48)] * 2
    assert not hiding(joined(fog, wall()), cameras_at(-1, 1))[0]
    assert hiding(joined(fog, wall()), cameras_at(-1, 1), narrow)[0]


def test_one_photo_has_no_neighbour():
    assert not hiding(joined(FOG, wall()), cameras_at(1)).any()


def test_automatic_pruning_leaves_fog_out():
    """A draft is never optimised on the photos, where fog was looked for alone."""
    scene, cameras = joined(FOG, wall()), cameras_at(-1, 1)
    masks = torch.ones(2, SIZE, SIZE, dtype=torch.bool)
    views = Views(render(scene, cameras).colour, masks, ("a", "b"), ((SIZE, SIZE),) * 2)
    prune = pruning_to("auto", 2)
    assert prune
    pruned = prune(scene, RenderingLoss(views, cameras), 30.0)
    assert not pruned.kept[0]
    assert pruned.kept[1:].sum() > 50
    assert pruned.psnr_after == RenderingLoss(views, cameras).psnr(scene[pruned.kept], [0, 1])
