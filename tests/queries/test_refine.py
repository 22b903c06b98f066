"""Rounds of refinement: what they read does not depend on the frame, and untrained ones change nothing."""

from dataclasses import fields, replace

import torch
from tests.model.model_scenes import anchors, compact, memories
from torch import Tensor
from torch.nn import functional as F

from querysplat_cli.encoders.base import Geometry
from querysplat_cli.model.anchors import Anchors
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.model.refiner import GEOMETRY_ROW, STENCIL, Evidence
from querysplat_cli.queries.evidence import Surroundings, _bilinear, gather_evidence
from querysplat_cli.queries.policy import QUERY_POLICY
from querysplat_cli.queries.refine import refined, refinements
from querysplat_cli.queries.rendering_error import Comparison, compare, prior_gaussians
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.rotations import quaternion_product, quaternion_to_matrix
from querysplat_cli.scene.sim3 import Sim3
from querysplat_cli.scene.views import Views

HEIGHT, WIDTH, VIEWS = 24, 36, 3


def cameras(count: int = VIEWS) -> Cameras:
    K = torch.tensor([[30.0, 0, WIDTH / 2], [0, 32.0, HEIGHT / 2], [0, 0, 1]]).repeat(count, 1, 1)
    w2c = torch.eye(4).repeat(count, 1, 1)
    w2c[:, 0, 3] = torch.linspace(-0.6, 0.6, count)
    return Cameras(w2c, K, HEIGHT, WIDTH)


def photos(count: int = VIEWS) -> Views:
    images = torch.rand(count, 3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(3))
    masks = torch.ones(count, HEIGHT, WIDTH, dtype=torch.bool)
    return Views(images, masks, tuple(str(view) for view in range(count)), ((HEIGHT, WIDTH),) * count)


def geometry(count: int = VIEWS) -> Geometry:
    generator = torch.Generator().manual_seed(4)
    depth = 4 + torch.rand(count, HEIGHT, WIDTH, generator=generator)
    return Geometry(depth, torch.rand(count, HEIGHT, WIDTH, generator=generator), (), 6)


def evidence(found: Anchors, where: Cameras, depth: Tensor, count: int = VIEWS, width: int = WIDTH) -> Evidence:
    """Of a scene whose comparison with the photos, so wide, is made up; its depth is a tenth above the VGM's."""
    views, sure = replace(photos(count), sizes=((HEIGHT, width),) * count), geometry(count).confidence
    assert sure is not None
    errors = torch.zeros(found.opacities.numel(), 11).to(depth)
    comparison = Comparison(errors, 0.1 * views.images.to(depth), sure.to(depth), 1.1 * depth)
    near = torch.arange(len(found))[:, None].roll(1, 0)
    around = Surroundings(replace(views, images=views.images.to(depth)), where, depth, sure.to(depth), near)
    raw = torch.zeros(len(found), 5).to(depth)
    return gather_evidence(found, prior_gaussians(found), raw, comparison, around)


def doubled(found: Anchors) -> Anchors:
    parts = {field.name: getattr(found, field.name) for field in fields(found)}
    return Anchors(**{name: part.double() if isinstance(part, Tensor) else part for name, part in parts.items()})


def test_evidence_depends_neither_on_the_frame_nor_on_the_unit() -> None:
    found, where = doubled(anchors(compact())), cameras().to(torch.float64)
    depth = geometry().depth
    assert depth is not None
    turn = F.normalize(torch.tensor([0.8, 0.3, -0.4, 0.2], dtype=torch.float64), dim=0)
    move = Sim3(2.5, quaternion_to_matrix(turn[None])[0], torch.tensor([1.0, -2, 3], dtype=torch.float64))
    quats = found.quats.flatten(0, 1)
    moved = replace(
        found,
        means=move.apply(found.means),
        scales=found.scales * 2.5,
        spacing=found.spacing * 2.5,
        quats=quaternion_product(turn.expand(quats.shape), quats).view_as(found.quats),
    )
    before, after = (
        evidence(found, where, depth.double()),
        evidence(moved, where.transformed(move), 2.5 * depth.double()),
    )
    for field in fields(Evidence):
        torch.testing.assert_close(getattr(after, field.name), getattr(before, field.name), rtol=1e-7, atol=1e-7)


def test_a_query_on_the_surface_reads_no_gap_and_the_surface_that_is_there() -> None:
    """A plane at depth 4, and queries on it whose normal is the optical axis."""
    found = doubled(anchors(compact(), queries=5))
    middle = found.means.shape[1] // 2
    found.means[:, middle] = torch.tensor([0.1, -0.2, 4.0], dtype=torch.float64)
    found.quats[:] = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64)
    rows = evidence(found, cameras().to(torch.float64), torch.full((VIEWS, HEIGHT, WIDTH), 4.0).double())
    assert rows.seen.all()
    gaps, offset, normal = rows.geometry[0, :, :STENCIL], rows.geometry[0, :, 18:21], rows.geometry[0, :, 21:24]
    assert rows.geometry.shape[2] == GEOMETRY_ROW
    torch.testing.assert_close(gaps, torch.zeros_like(gaps))
    torch.testing.assert_close(offset, torch.zeros_like(offset))
    torch.testing.assert_close(normal.abs(), torch.tensor([0.0, 0, 1]).double().expand_as(normal))


def test_maps_are_read_between_pixels_as_torch_does_it() -> None:
    maps = torch.rand(2, 5, 7, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    pixels = 12 * torch.rand(50, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64) - 3
    views = torch.arange(50) % 2
    found = _bilinear(maps, views[:, None], pixels[:, None, None])[:, 0, 0]
    grid = 2 * pixels / torch.tensor([7.0, 5.0]).double() - 1
    each = F.grid_sample(maps.movedim(3, 1), grid.expand(2, 1, 50, 2), padding_mode="border", align_corners=False)
    torch.testing.assert_close(found, each[views, :, 0, torch.arange(50)])


def test_of_many_views_a_query_reads_the_nearest_that_see_it() -> None:
    count = QUERY_POLICY.refining_views + 4
    found = anchors(compact())
    depth = geometry(count).depth
    assert depth is not None
    where = cameras(count)
    rows = evidence(found, where, depth, count)
    assert rows.seen.shape[1] == QUERY_POLICY.refining_views
    middle = found.means[:, found.means.shape[1] // 2]
    seen_by = torch.stack([where.sees(middle, view) for view in range(count)], 1).sum(1)
    assert rows.seen.sum(1).equal(seen_by.clamp_max(QUERY_POLICY.refining_views))


def test_a_query_beside_a_smaller_photo_on_its_canvas_is_not_seen() -> None:
    found, depth = anchors(compact()), geometry().depth
    assert depth is not None
    narrow = WIDTH // 2
    seen = evidence(found, cameras(), depth, width=narrow).seen
    middle = found.means[:, found.means.shape[1] // 2]
    pictures = cameras().of_pictures([(HEIGHT, narrow)] * VIEWS)
    assert seen.equal(torch.stack([picture.sees(middle, 0) for picture in pictures], 1))
    assert seen.sum() < evidence(found, cameras(), depth).seen.sum()


def model_with_rounds(rounds: int = 2) -> tuple[QuerySplat, Anchors]:
    config = compact(refinement_rounds=rounds)
    torch.manual_seed(0)
    return QuerySplat(config), anchors(config)


def trained_model(rounds: int) -> tuple[QuerySplat, Anchors]:
    """Its heads are not zero."""
    model, found = model_with_rounds(rounds)
    for head in (model.refiner.geometry_head, model.refiner.appearance_head):
        torch.nn.init.normal_(head.weight, std=0.02)
    return model, found


def test_untrained_rounds_change_nothing() -> None:
    model, found = model_with_rounds()
    read = memories(model.config)
    after = refined(model, read, found, photos(), cameras(), geometry())
    assert after.refinement.shape == (len(found), model.config.gaussians_per_query, 23)
    assert not after.refinement.any()
    with torch.no_grad():
        before, now = model.decode(read, found), model.decode(read, after)
    for field in fields(Gaussians):
        torch.testing.assert_close(getattr(now, field.name), getattr(before, field.name), rtol=0, atol=0)


def test_the_refinement_of_a_round_is_what_the_scene_is_made_of() -> None:
    model, found = trained_model(2)
    views, where, depth = photos(), cameras(), geometry()
    rounds = list(refinements(model, memories(model.config), found, views, where, depth))
    assert len(rounds) == 2
    last, scene = rounds[-1], rounds[-1].scene
    kept = refined(model, memories(model.config), found, views, where, depth)
    torch.testing.assert_close(kept.refinement, last.refinement.detach())
    torch.testing.assert_close(kept.reading.geometry.float(), last.reading.geometry, rtol=0, atol=1e-3)
    assert kept.reading.views.equal(torch.arange(VIEWS).int().expand(len(found), -1))
    with torch.no_grad():
        decoded = model.decode(memories(model.config), kept)
    torch.testing.assert_close(decoded.means, scene.means.detach())
    torch.testing.assert_close(decoded.sh, scene.sh.detach())


def test_queries_attend_to_no_view_that_does_not_see_them() -> None:
    model, found = trained_model(1)
    where = cameras()
    after = refined(model, memories(model.config), found, photos(), where, geometry())
    middle = model.decode(memories(model.config), found).means.view(*found.opacities.shape, 3)[:, 4]
    seen = torch.stack([where.sees(middle, view) for view in range(VIEWS)], 1)
    for weights in (after.reading.geometry.float(), after.reading.appearance.float()):
        assert not weights[~seen].any()
        assert (weights[seen] > 0).all()
        assert (weights.sum(1) < 1).all()


def test_photos_change_what_queries_read_and_so_the_scene() -> None:
    """With values that are not zero, noise in the place of the photos or of the depth gives another scene."""
    model, found = trained_model(1)
    read, views, where, depth = memories(model.config), photos(), cameras(), geometry()
    usual = refined(model, read, found, views, where, depth).refinement
    noise = replace(views, images=1 - views.images)
    assert not torch.allclose(refined(model, read, found, noise, where, depth).refinement, usual)
    assert depth.depth is not None
    deeper = replace(depth, depth=1.5 * depth.depth)
    assert not torch.allclose(refined(model, read, found, views, where, deeper).refinement, usual)


def test_a_comparison_over_grey_has_an_error_where_the_scene_has_holes() -> None:
    found = anchors(compact(), queries=5)
    grey = replace(photos(), images=torch.full((VIEWS, 3, HEIGHT, WIDTH), 0.5))
    scene = prior_gaussians(found).map(Tensor.float)
    over_grey, over_black = (compare(scene, grey, cameras(), background) for background in (0.5, 0.0))
    empty = over_grey.alpha == 0
    assert empty.any()
    assert over_grey.residual.movedim(1, 3)[empty].abs().max() < 1e-6
    assert over_black.residual.movedim(1, 3)[empty].min() > 0.4


def test_fewer_queries_than_neighbours() -> None:
    model, _ = model_with_rounds(1)
    found = anchors(model.config, queries=5)
    assert not refined(model, memories(model.config), found, photos(), cameras(), geometry()).refinement.any()
