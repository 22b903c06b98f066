"""Anchors against closed forms: planes seen from known places."""

import math

import pytest
import torch
from scipy.spatial.transform import Rotation

from querysplat_cli.encoders.base import Geometry
from querysplat_cli.model.anchors import Anchors
from querysplat_cli.model.checkpoints import load
from querysplat_cli.queries.build import build_anchors
from querysplat_cli.queries.cells import CELLS, measure_cells
from querysplat_cli.queries.coverage import AnchorReport, choose_blocks, compare_views
from querysplat_cli.queries.features import FEATURES
from querysplat_cli.queries.policy import QUERY_POLICY
from querysplat_cli.queries.rendering_error import with_rendering_error
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import SH_0, Gaussians
from querysplat_cli.scene.sim3 import Sim3
from querysplat_cli.scene.views import Views
from querysplat_cli.splat.render import render

HEIGHT, WIDTH, FOCAL, DEPTH = 36, 48, 40.0, 2.0
BLOCKS = (HEIGHT // 6) * (WIDTH // 6)


def plane(shifts: list[float], seed: int = 0) -> tuple[Views, Cameras, torch.Tensor, torch.Tensor]:
    """Cameras side by side that look straight at the plane z = 2; random pictures, confidence 1 everywhere."""
    count = len(shifts)
    w2c = torch.eye(4).repeat(count, 1, 1)
    w2c[:, 0, 3] = -torch.tensor(shifts)
    K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]]).repeat(count, 1, 1)
    images = torch.rand(count, 3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(seed))
    masks = torch.ones(count, HEIGHT, WIDTH, dtype=torch.bool)
    names = tuple(f"{i}.png" for i in range(count))
    views = Views(images, masks, names, ((HEIGHT, WIDTH),) * count)
    return views, Cameras(w2c, K, HEIGHT, WIDTH), torch.full(masks.shape, DEPTH), torch.ones(masks.shape)


def build(
    views: Views,
    cameras: Cameras,
    depth: torch.Tensor,
    confidence: torch.Tensor,
    *,
    queries: int | None = None,
    soft: int | None = None,
) -> tuple[Anchors, AnchorReport]:
    geometry = Geometry(depth, confidence, (), 6)
    return build_anchors(views, cameras, geometry, queries=queries, soft_query_limit=soft)


def test_one_view_of_a_plane() -> None:
    views, cameras, depth, confidence = plane([0.0])
    anchors, report = build(views, cameras, depth, confidence)
    assert report == AnchorReport(blocks=BLOCKS, kept=BLOCKS, redundant=0, hiding=0, empty=0, beyond=report.beyond)
    assert len(anchors) == BLOCKS + report.beyond
    torch.testing.assert_close(anchors.means[..., 2], torch.full(anchors.means.shape[:2], DEPTH))
    pixel = anchors.means[..., :2] / DEPTH * FOCAL + torch.tensor([WIDTH / 2, HEIGHT / 2])
    first = torch.tensor([[x, y] for y in (1.0, 3, 5) for x in (1.0, 3, 5)])
    torch.testing.assert_close(pixel[0], first)
    cell = 2 * DEPTH / FOCAL
    torch.testing.assert_close(anchors.scales[:BLOCKS, :, :2], torch.full((BLOCKS, 9, 2), QUERY_POLICY.fill * cell))
    torch.testing.assert_close(anchors.spacing[:BLOCKS], torch.full((BLOCKS,), 3 * cell))
    torch.testing.assert_close(anchors.colours[0, 0], views.images[0, :, :2, :2].mean((1, 2)))
    normal = torch.from_numpy(Rotation.from_quat(anchors.quats[:, 0].roll(-1, 1).numpy()).as_matrix())[:, :, 2]
    torch.testing.assert_close(normal[:, 2].abs(), torch.ones(len(anchors), dtype=torch.float64))


def test_a_second_photo_from_the_same_place_adds_nothing() -> None:
    anchors, report = build(*plane([0.0, 0.0]))
    assert (report.kept, report.redundant) == (BLOCKS, BLOCKS)
    assert len(anchors) == BLOCKS + report.beyond


def test_a_view_to_the_side_adds_what_only_it_sees() -> None:
    """The second view is shifted by two blocks, so only its last two columns of blocks are new."""
    _, report = build(*plane([0.0, 12 * DEPTH / FOCAL]))
    assert report.kept == BLOCKS + 2 * HEIGHT // 6


def test_confident_views_average_their_colours_and_guesses_count_less() -> None:
    views, cameras, depth, confidence = plane([0.0, 0.0])
    views.images[0], views.images[1] = 0.2, 0.6
    colours = build(views, cameras, depth, confidence)[0].colours[:BLOCKS]
    torch.testing.assert_close(colours, torch.full_like(colours, 0.4))
    confidence[1] = 0
    colours = build(views, cameras, depth, confidence)[0].colours[:BLOCKS]
    torch.testing.assert_close(colours, torch.full_like(colours, 0.2))


def test_a_guess_in_front_of_what_others_see_is_left_out() -> None:
    views, cameras, depth, confidence = plane([0.0, 0.0, 0.0])
    depth[2, :12], confidence[2, :12] = 1.0, 0.0  # two rows of blocks stand halfway to the plane
    _, report = build(views, cameras, depth, confidence)
    assert report.hiding == 2 * WIDTH // 6


def test_what_the_mask_hides_has_no_query() -> None:
    views, cameras, depth, confidence = plane([0.0])
    views.masks[:, :, 24:] = False
    anchors, report = build(views, cameras, depth, confidence)
    assert (report.kept, report.empty) == (BLOCKS // 2, BLOCKS // 2)
    assert float(anchors.means[: report.kept, :, 0].max()) < 0.01


@pytest.mark.parametrize("outside", [0.0, -1.0, math.nan, math.inf])
def test_depth_outside_of_masks_is_never_used(outside: float) -> None:
    """An encoder need not know it. Blocks at the border of a mask have pixels on both sides."""
    views, cameras, depth, confidence = plane([0.0, 0.2])
    views.masks[:, :, 25:] = False
    expected, _ = build(views, cameras, depth, confidence)
    depth[~views.masks] = outside
    found, _ = build(views, cameras, depth, confidence)
    torch.testing.assert_close(found.means, expected.means)
    torch.testing.assert_close(found.scales, expected.scales)


def test_masks_that_leave_nothing_are_refused() -> None:
    views, cameras, depth, confidence = plane([0.0])
    views.masks[:] = False
    views.masks[:, :2, :2] = True
    with pytest.raises(QuerySplatError, match="hide nearly all"):
        build(views, cameras, depth, confidence)


@pytest.mark.parametrize("limit", [BLOCKS, 40, 10, 1])
def test_a_limit_on_queries(limit: int) -> None:
    anchors, report = build(*plane([0.0]), queries=limit)
    assert len(anchors) == report.kept + report.beyond <= limit


def test_a_limit_that_cannot_be_kept_is_refused() -> None:
    apart = plane([0.0, 1000.0, 2000.0])
    assert build(*apart, queries=3)[1].kept == 3
    with pytest.raises(QuerySplatError, match="--queries 2: these photos need 3"):
        build(*apart, queries=2)


@pytest.mark.parametrize("soft", [BLOCKS, BLOCKS - 1, 20])
def test_a_soft_limit_cuts_the_photos_more_coarsely_and_keeps_what_lies_beyond(soft: int) -> None:
    _, report = build(*plane([0.0]), soft=soft)
    assert report.kept <= soft
    assert (report.side == CELLS * QUERY_POLICY.finest_cell) == (soft == BLOCKS)
    assert report.beyond > 0


@pytest.mark.parametrize("soft", [3, 9, 20, 40, 60, 80, 100])
def test_blocks_are_the_finest_that_keep_a_limit(soft: int) -> None:
    """As trying one size after another finds them, from the finest on."""
    scene = plane([0.0, 0.3, 0.7])
    kept = {}
    for cell in range(QUERY_POLICY.finest_cell, WIDTH // CELLS + 1):
        cells = measure_cells(*scene, cell)
        comparison = compare_views(cells, *scene)
        kept[CELLS * cell] = choose_blocks(cells, comparison, scene[1], cell, keep_all=False)[1].kept
    assert build(*scene, soft=soft)[1].side == next(side for side, count in kept.items() if count <= soft)


def test_a_soft_limit_is_exceeded_where_the_photos_alone_are_more() -> None:
    apart = plane([0.0, 1000.0, 2000.0])
    assert build(*apart, soft=2)[1].kept == 3


def test_neighbours_are_the_nearest_patches() -> None:
    views, cameras, depth, confidence = plane([0.0])
    anchors, _ = build(views, cameras, depth, confidence)
    assert torch.equal(anchors.geometry.index[:BLOCKS, 0], torch.arange(BLOCKS))
    assert bool((anchors.geometry.bias.diff(dim=1) <= 0).all())
    assert torch.equal(anchors.queries.index[:, 0], torch.arange(len(anchors)))


def prior(anchors: Anchors) -> Gaussians:
    sh = ((anchors.colours.flatten(0, 1) - 0.5) / SH_0)[:, None]
    parts = (anchors.means, anchors.quats, anchors.scales)
    return Gaussians(*(part.flatten(0, 1) for part in parts), anchors.opacities.flatten(), sh)


def test_the_plane_continues_outside_the_photo() -> None:
    """Even stripes along x have no end: a camera half a picture to the left sees them where no photo does."""
    views, cameras, depth, confidence = plane([0.0])
    views.images[:] = torch.linspace(0.2, 0.8, HEIGHT)[:, None]
    anchors, report = build(views, cameras, depth, confidence)
    aside = Cameras(cameras.w2c.clone(), cameras.K, HEIGHT, WIDTH)
    aside.w2c[:, 0, 3] = WIDTH / 2 * DEPTH / FOCAL
    found = render(prior(anchors), aside)
    # The two columns and rows at the ends blend into the black that is there.
    seen = slice(None), slice(2, -2), slice(2, WIDTH // 2)
    assert float(found.alpha[seen].min()) > 0.5
    torch.testing.assert_close(found.depth[seen], torch.full_like(found.depth[seen], DEPTH), atol=1e-3, rtol=0)
    colour = (found.colour / found.alpha[:, None])[:, 0][seen]
    assert float((colour - views.images[:, 0][seen]).abs().max()) < 0.6 * 8 / HEIGHT
    inside = prior(anchors).map(lambda part: part[: 9 * report.kept])
    assert float(render(inside, aside).alpha[:, :, : WIDTH // 2 - 4].max()) < 0.01


def test_no_query_extends_a_photo_where_another_photo_shows_the_place() -> None:
    """Two views side by side: extensions between the views are left out, and the outer ones stay."""
    scene = plane([0.0, WIDTH / 2 * DEPTH / FOCAL])
    anchors, report = build(*scene)
    beyond = anchors.means[report.kept :]
    pixel = beyond[..., :2] / DEPTH * FOCAL + torch.tensor([WIDTH / 2, HEIGHT / 2])
    inside = (pixel > 0).all(-1) & (pixel < torch.tensor([1.5 * WIDTH, HEIGHT])).all(-1)
    assert float(inside.float().mean(1).max()) <= 0.5
    for axis, edge in ((0, 1.5 * WIDTH), (1, HEIGHT)):
        assert bool((pixel[..., axis] < 0).any())
        assert bool((pixel[..., axis] > edge).any())
    torch.testing.assert_close(anchors.spacing[-1], anchors.spacing[0] * QUERY_POLICY.border_coarser)


def test_cut_out_things_do_not_go_on_beyond_the_photos() -> None:
    """Where masks leave less than half of the photos, they leave out what is around the things in them."""
    views, cameras, depth, confidence = plane([0.0])
    for shown, beyond in ((WIDTH, True), (WIDTH // 4, False)):
        views.masks[:, :, shown:] = False
        assert (build(views, cameras, depth, confidence)[1].beyond > 0) == beyond


def test_blocks_outside_the_photos_keep_about_the_size_of_their_prior() -> None:
    """The bundled decoder was not trained on any. With their true features it makes them several times larger."""
    views, cameras, depth, confidence = plane([0.0, 0.3])
    anchors, report = build(views, cameras, depth, confidence)
    anchors = with_rendering_error(anchors, views, cameras)
    model = load("compact")
    features = torch.zeros(2, BLOCKS, 12)
    with torch.no_grad():
        scales = model.decode(model.embed((features,), views.images, cameras), anchors).scales
    grown = (scales / prior(anchors).scales)[9 * report.kept :, :2]
    assert report.beyond > 0
    assert float(grown.median()) < 2


def test_the_features_of_an_anchor_do_not_depend_on_the_frame() -> None:
    views, cameras, depth, confidence = plane([0.0, 0.317])
    # Off the pixels' edges, where rounding would decide which pixel a point falls into.
    cameras.w2c[1, 1, 3] = 0.113
    depth[0, 10:] *= 1.2
    turn = torch.from_numpy(Rotation.from_rotvec([0.3, -0.8, 0.5]).as_matrix())
    moved = cameras.transformed(Sim3(2.5, turn, torch.tensor([3.0, -1, 2], dtype=torch.float64)))
    before, _ = build(views, cameras, depth, confidence)
    after, _ = build(views, moved, 2.5 * depth, confidence)
    assert before.features.shape == (len(before), FEATURES)
    assert before.features.std(0).gt(0).sum() > FEATURES // 2
    torch.testing.assert_close(after.features, before.features, rtol=1e-4, atol=2e-4)


def test_features_state_the_distance_from_the_borders() -> None:
    anchors, report = build(*plane([0.0]))
    near = anchors.features[: report.kept, 6:10].reshape(HEIGHT // 6, WIDTH // 6, 4)
    assert near[0, 0].tolist() == [0, 1, 0, 1]
    assert near[-1, 1].tolist() == [1, 0, 0.25, 1]
