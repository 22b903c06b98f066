"""Where anchored queries stand: points spread over the VGM's point cloud, with a prior for each Gaussian.

The pictures are cut into square blocks, one query each, and every block into 3 × 3 cells, one Gaussian
each. Views come one after another: a block whose surface the blocks kept so far cover about as finely is left
out, and so is one that stands in front of surfaces which other views see with confidence. Beside the photos,
where no photo looks, coarser blocks carry on what their borders show.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from querysplat_cli.model.anchors import Anchors, Neighbours
from querysplat_cli.queries.outpaint import extend_borders
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.rotations import matrix_to_quaternion
from querysplat_cli.scene.views import Views

CELLS = 3
"""Cells along a block's side; a query owns CELLS² Gaussians."""
FINEST = 2 * CELLS
"""Pixels along the side of the smallest blocks."""
COMPARED_VIEWS = 16
"""Each view is compared with this many nearest others, so that time stays linear in the views."""
DEPTH_AGREEMENT = 0.03
"""Relative depth difference up to which two views see the same surface."""
COARSER = 1.1
"""A cell covers one of another view if it is at most this much larger."""
COVERED = 0.95
"""Share of its cells that must be covered before a block is left out."""
FREE_SPACE = 0.1
"""A point nearer than a confident surface by more than this fraction would hide that surface."""
FILL = 0.7
"""Standard deviation of a prior Gaussian in units of its cell: neighbours just close the surface."""
THICKNESS = 0.2
"""Extent along the normal in the same units."""
BORDER = 0.1
"""Photos go on beyond their borders by this share of the longer side, up to whole blocks."""
BORDER_COARSER = 4
"""Cells out there are so much larger."""
DISTANCE_PENALTY = 2.0
"""Attention logit lost per squared distance, in spacings, between a query and a memory row."""
FEATURES = 10 + 10 * CELLS**2
"""Numbers that describe an anchor as it is built: those of its block, then those of its cells."""
NEAR_BORDER = 4
"""Blocks from the picture's border within which an anchor knows how near it is."""


@dataclass(frozen=True)
class AnchorReport:
    """How many blocks of `side` pixels the pictures have, and why some carry no query; `beyond` are the queries beside
    them."""

    blocks: int
    kept: int
    redundant: int
    hiding: int
    empty: int
    beyond: int = 0
    side: int = FINEST


def build_anchors(
    views: Views,
    cameras: Cameras,
    depth: Float[Tensor, "views height width"],
    confidence: Float[Tensor, "views height width"],
    *,
    patch: int,
    queries: int | None = None,
    about: int | None = None,
    near: int = 4,
    everything: bool = False,
) -> tuple[Anchors, AnchorReport]:
    """Anchored queries for a scene whose depth (camera z, scene units) is known.

    Memory rows are the patches of `patch` pixels, view by view, row by row; each query attends to the
    `near` nearest of them in space. `queries` limits their number by cutting the pictures more coarsely;
    None keeps a block for each patch that shows something no other view shows as well, or, with `everything`,
    for each patch. Queries beyond the borders come last, as many as the limit leaves room for. `about` is a limit for
    those within alone, and only as far as it can be kept. Raises QuerySplatError when photos that show
    different things are more than `queries`.
    """
    block, limit = FINEST, about if queries is None else queries
    while True:
        cells = _cells(views, cameras, depth, confidence, block // CELLS)
        seen = _compare_views(cells, views, cameras, depth, confidence)
        keep, report = _choose_blocks(cells, seen, cameras, block // CELLS, everything)
        if limit is None or report.kept <= limit:
            break
        if block >= max(cameras.height, cameras.width):
            if queries is None:
                break
            raise QuerySplatError(
                f"--queries {queries}: these photos need {report.kept}, even one for a whole photo", "Ask for more."
            )
        block += CELLS
    border = _border(views, cameras, depth, BORDER_COARSER * (block // CELLS))
    if queries is not None:
        border = border.map(lambda part: part[: queries - report.kept])
    usual = cells.footprint.mean(-1).log().median()
    features = torch.cat([_features(cells, seen, _nearness(cells.depth), usual)[keep], _beyond(border)])
    cells = replace(cells, colour=seen.colour).map(lambda part: part[keep]).joined(border)
    means, scales, quats = _discs(cells)
    spacing = (cells.footprint * CELLS).mean(1)
    centres = means[:, CELLS**2 // 2]
    tokens = _patch_positions(cameras, depth, patch)
    memory = _neighbours(centres, spacing, tokens, near)
    anchors = Anchors(
        means=means,
        scales=scales,
        quats=quats,
        opacities=torch.where(cells.valid, 0.6 + 0.35 * cells.confidence, 0.01),
        colours=cells.colour,
        spacing=spacing,
        features=features,
        geometry=memory,
        appearance=memory,
        queries=_neighbours(centres, spacing, centres, near),
    )
    return anchors, replace(report, beyond=len(border.point), side=block)


@dataclass(frozen=True)
class _Cells:
    """The cells of every block of every view, [views, rows, columns, 9, …], or of chosen blocks, [blocks, 9, …]."""

    point: Float[Tensor, "*blocks cells 3"]
    depth: Float[Tensor, "*blocks cells"]
    footprint: Float[Tensor, "*blocks cells"]
    confidence: Float[Tensor, "*blocks cells"]
    colour: Float[Tensor, "*blocks cells 3"]
    valid: Bool[Tensor, "*blocks cells"]
    along_x: Float[Tensor, "*blocks cells 3"]
    along_y: Float[Tensor, "*blocks cells 3"]
    normal: Float[Tensor, "*blocks cells 3"]
    origin: Float[Tensor, "*blocks cells 3"]

    def map(self, change: Callable[[Tensor], Tensor]) -> "_Cells":
        return _Cells(**{name: change(part) for name, part in vars(self).items()})

    def joined(self, other: "_Cells") -> "_Cells":
        return _Cells(**{name: torch.cat([part, getattr(other, name)]) for name, part in vars(self).items()})


@dataclass(frozen=True)
class _Seen:
    """What the other views say of each cell."""

    hiding: Bool[Tensor, "*blocks cells"]
    colour: Float[Tensor, "*blocks cells 3"]
    supporters: Float[Tensor, "*blocks cells"]
    hidden: Float[Tensor, "*blocks cells"]


def _to_blocks(grid: Tensor) -> Tensor:
    """[V, rows·3, columns·3, …] → [V, rows, columns, 9, …]."""
    views, height, width = grid.shape[:3]
    split = grid.reshape(views, height // CELLS, CELLS, width // CELLS, CELLS, *grid.shape[3:])
    return split.transpose(2, 3).flatten(3, 4)


def _from_blocks(blocks: Tensor) -> Tensor:
    """[rows, columns, 9] → [rows·3, columns·3]."""
    rows, columns, _ = blocks.shape
    return blocks.reshape(rows, columns, CELLS, CELLS).transpose(1, 2).reshape(rows * CELLS, columns * CELLS)


def _windows(maps: Tensor, cell: int, block: int) -> Tensor:
    """[V, H, W] → the pixels of each cell: [V, H/cell, W/cell, cell²], edges repeated up to whole blocks."""
    views, height, width = maps.shape
    pad = (0, -width % block, 0, -height % block)
    padded = torch.nn.functional.pad(maps[:, None], pad, mode="replicate")[:, 0] if any(pad) else maps
    rows, columns = padded.shape[1] // cell, padded.shape[2] // cell
    return padded.reshape(views, rows, cell, columns, cell).transpose(2, 3).flatten(3)


def _cells(views: Views, cameras: Cameras, depth: Tensor, confidence: Tensor, cell: int) -> _Cells:
    block = cell * CELLS
    # The median stays on one side of a depth edge, where a mean would hang in the air between.
    z = _windows(depth, cell, block).median(-1).values
    trust = _windows(confidence, cell, block).mean(-1)
    valid = _windows(views.masks.float(), cell, block).mean(-1) > 0.5
    weight = _windows(views.masks.float(), cell, block).clamp_min(1e-6)
    colour = torch.stack(
        [(_windows(channel, cell, block) * weight).sum(-1) / weight.sum(-1) for channel in views.images.unbind(1)], -1
    )
    _, rows, columns = z.shape
    u = (torch.arange(columns) + 0.5) * cell
    v = (torch.arange(rows) + 0.5) * cell
    fx, fy, cx, cy = (part[:, None, None] for part in _intrinsics(cameras))
    c2w = cameras.c2w
    directions = torch.stack([(u - cx) / fx + 0 * z, (v[:, None] - cy) / fy + 0 * z, torch.ones_like(z)], -1)
    rotated = torch.einsum("vij,vrcj->vrci", c2w[:, :3, :3], directions)
    origin = c2w[:, None, None, :3, 3].expand_as(rotated)
    point = origin + z[..., None] * rotated
    footprint = z * cell / (fx * fy).sqrt()
    along_x, along_y, normal = _tangents(point, rotated, footprint, c2w)
    return _Cells(
        *map(_to_blocks, (point, z, footprint, trust, colour, valid, along_x, along_y, normal, origin)),
    )


def _features(
    cells: _Cells, seen: _Seen, border: Float[Tensor, "*blocks 4"], usual: Float[Tensor, ""]
) -> Float[Tensor, "*blocks channels"]:
    """What is known of each block before anything is read or rendered, each number about 1 in size.

    Of the block: mean colour, confidence, size, slant, and how near the picture's four borders are. Of its cells:
    colour and what the other views add to it, confidence, depth, how many views agree with it and how many it hides.
    """
    mean = seen.colour.mean(-2, keepdim=True)
    spacing = CELLS * cells.footprint.mean(-1, keepdim=True)
    ray = torch.nn.functional.normalize(cells.point - cells.origin, dim=-1)
    slant = (cells.normal * ray).sum(-1).abs().mean(-1, keepdim=True)
    # Relative to the `usual` logarithm: the pictures' size and the scene's say nothing about a block.
    size = cells.footprint.mean(-1, keepdim=True).log() - usual
    whole = (mean[..., 0, :] - 0.5, cells.confidence.mean(-1, keepdim=True), size, slant, border)
    relative = (cells.depth - cells.depth.median(-1, keepdim=True).values) / spacing
    apart = (
        4 * (seen.colour - mean).flatten(-2),
        4 * (cells.colour - seen.colour).flatten(-2),
        cells.confidence,
        relative.clamp(-2, 2),
        (seen.supporters / 2).clamp_max(2),
        (seen.hidden / 2).clamp_max(2),
    )
    return torch.cat([*whole, *apart], -1)


def _beyond(border: _Cells) -> Float[Tensor, "blocks channels"]:
    """The features of blocks beside the photos, with which no view agrees.

    No decoder was trained on such blocks, so they pass for inner ones of the usual size: told as they are, sizes come
    out threefold and bury what the photos show (held out, 9 dB on fortress).
    """
    nothing = torch.zeros_like(border.depth)
    seen = _Seen(nothing > 0, border.colour, nothing, nothing)
    usual = border.footprint.mean(-1).log().median()
    return _features(border, seen, nothing.new_ones(len(nothing), 4), usual)


def _nearness(blocks: Float[Tensor, "views rows columns cells"]) -> Float[Tensor, "views rows columns 4"]:
    """How far each block is from the picture's four borders, 1 from `NEAR_BORDER` blocks on."""
    views, rows, columns, _ = blocks.shape
    row, column = torch.arange(rows).float(), torch.arange(columns).float()
    sides = torch.broadcast_tensors(
        row[:, None], rows - 1 - row[:, None], column.expand(rows, columns), columns - 1 - column.expand(rows, columns)
    )
    return (torch.stack(sides, -1) / NEAR_BORDER).clamp_max(1).expand(views, rows, columns, 4)


def _tangents(point: Tensor, ray: Tensor, footprint: Tensor, c2w: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Steps on the surface to the next cell right and below, and the unit normal towards the camera.

    Across a depth edge, or where the surface is seen under a very flat angle, the step is unreliable:
    there the disc faces the camera.
    """
    along_x = torch.gradient(point, dim=2)[0]
    along_y = torch.gradient(point, dim=1)[0]
    facing_x = c2w[:, None, None, :3, 0] * footprint[..., None]
    facing_y = c2w[:, None, None, :3, 1] * footprint[..., None]
    limit = 3 * footprint[..., None]
    steep = (along_x.norm(dim=-1, keepdim=True) > limit) | (along_y.norm(dim=-1, keepdim=True) > limit)
    along_x = torch.where(steep, facing_x, along_x)
    along_y = torch.where(steep, facing_y, along_y)
    normal = torch.nn.functional.normalize(torch.linalg.cross(along_y, along_x), dim=-1)
    return along_x, along_y, normal


def _intrinsics(cameras: Cameras) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    return cameras.K[:, 0, 0], cameras.K[:, 1, 1], cameras.K[:, 0, 2], cameras.K[:, 1, 2]


def _compare_views(cells: _Cells, views: Views, cameras: Cameras, depth: Tensor, confidence: Tensor) -> _Seen:
    """Project the cells of each view into the others and compare depth and colour."""
    count = len(views)
    distance = torch.cdist(cameras.centres, cameras.centres)
    shape = cells.depth.shape
    supporters = torch.zeros(shape)
    hidden = torch.zeros(shape)
    colour = cells.colour.clone()
    weight = torch.ones(shape)
    for own in range(count):
        points = cells.point[own].reshape(-1, 3)
        for other in distance[own].argsort(stable=True)[: COMPARED_VIEWS + 1].tolist():
            if other == own:
                continue
            inside, row, column, z = _seen_by(other, points, views, cameras)
            surface = depth[other, row, column]
            same = inside & ((z / surface - 1).abs() < DEPTH_AGREEMENT)
            sure = confidence[other, row, column]
            in_front = inside & (z < surface * (1 - FREE_SPACE)) & (sure > 0.5)
            supporters[own] += (same * sure).reshape(shape[1:])
            hidden[own] += in_front.reshape(shape[1:])
            share = (same * sure).reshape(shape[1:])
            sample = views.images[other][:, row, column].T.reshape(*shape[1:], 3)
            colour[own] += share[..., None] * sample
            weight[own] += share
    hiding = hidden > supporters + cells.confidence
    return _Seen(hiding, colour / weight[..., None], supporters, hidden)


def _seen_by(
    view: int, points: Float[Tensor, "n 3"], views: Views, cameras: Cameras
) -> tuple[Bool[Tensor, "n"], Int[Tensor, "n"], Int[Tensor, "n"], Float[Tensor, "n"]]:
    """Whether points fall on the photo, behind a surface or not; their pixel's row and column, and camera z."""
    fx, fy, cx, cy = (part[view] for part in _intrinsics(cameras))
    local = points @ cameras.w2c[view, :3, :3].T + cameras.w2c[view, :3, 3]
    z = local[:, 2].clamp_min(1e-6)
    x = local[:, 0] / z * fx + cx
    y = local[:, 1] / z * fy + cy
    inside = (local[:, 2] > 1e-6) & (x >= 0) & (y >= 0) & (x < cameras.width) & (y < cameras.height)
    column = x.clamp(0, cameras.width - 1).long()
    row = y.clamp(0, cameras.height - 1).long()
    return inside & views.masks[view, row, column], row, column, z


def _border(views: Views, cameras: Cameras, depth: Tensor, cell: int) -> _Cells:
    """Blocks beside the photos, of cells of `cell` pixels, where none of the photos looks."""
    block = cell * CELLS
    margin = block * math.ceil(BORDER * max(depth.shape[1:]) / block)
    around = extend_borders(views, cameras, depth, cell=cell, margin=margin)
    cells = _cells(around.views, around.cameras, around.depth, torch.zeros_like(around.depth), 1)
    wanted = cells.valid.float().mean(-1) > 0.5
    points = cells.point[wanted].reshape(-1, 3)
    seen = torch.zeros(len(points), dtype=torch.bool)
    for view in range(len(views)):
        seen |= _seen_by(view, points, views, cameras)[0]
    wanted[wanted.clone()] = seen.reshape(-1, CELLS**2).float().mean(1) <= 0.5
    keep = _uncovered(cells, wanted, around.cameras, 1)
    return cells.map(lambda part: part[keep])


def _choose_blocks(
    cells: _Cells, seen: _Seen, cameras: Cameras, cell: int, everything: bool
) -> tuple[Bool[Tensor, "views rows columns"], AnchorReport]:
    empty = cells.valid.float().mean(-1) <= 0.5
    if everything:
        shown = int((~empty).sum())
        return ~empty, AnchorReport(empty.numel(), shown, 0, 0, empty.numel() - shown)
    hiding = ~empty & (seen.hiding.float().mean(-1) > 0.5)
    keep = _uncovered(cells, ~empty & ~hiding, cameras, cell)
    redundant = ~empty & ~hiding & ~keep
    counts = (int(part.sum()) for part in (keep, redundant, hiding, empty))
    return keep, AnchorReport(keep.numel(), *counts)


def _uncovered(
    cells: _Cells, wanted: Bool[Tensor, "views rows columns"], cameras: Cameras, cell: int
) -> Bool[Tensor, "views rows columns"]:
    """The wanted blocks that show what no block kept before them shows."""
    keep = torch.zeros_like(wanted)
    for own in range(len(cameras)):
        points, footprint = cells.point[keep].reshape(-1, 3), cells.footprint[keep].reshape(-1)
        covered = _covered(cells, cameras, own, cell, points, footprint)
        keep[own] = wanted[own] & (covered.float().mean(-1) < COVERED)
    return keep


def _covered(
    cells: _Cells,
    cameras: Cameras,
    own: int,
    cell: int,
    points: Float[Tensor, "n 3"],
    footprint: Float[Tensor, "n"],
) -> Bool[Tensor, "rows columns cells"]:
    """Which cells of a view lie where one of `points`, fine enough, puts the same surface."""
    fx, fy, cx, cy = (float(part[own]) for part in _intrinsics(cameras))
    local = points @ cameras.w2c[own, :3, :3].T + cameras.w2c[own, :3, 3]
    z = local[:, 2].clamp_min(1e-6)
    depth, size = (_from_blocks(part[own]) for part in (cells.depth, cells.footprint))
    column = torch.floor((local[:, 0] / z * fx + cx) / cell).clamp(-1, depth.shape[1]).long()
    row = torch.floor((local[:, 1] / z * fy + cy) / cell).clamp(-1, depth.shape[0]).long()
    inside = (local[:, 2] > 1e-6) & (column >= 0) & (row >= 0) & (column < depth.shape[1]) & (row < depth.shape[0])
    z, row, column, footprint = z[inside], row[inside], column[inside], footprint[inside]
    same = ((z / depth[row, column] - 1).abs() < DEPTH_AGREEMENT) & (footprint < COARSER * size[row, column])
    hits = torch.zeros_like(depth)
    hits[row[same], column[same]] = 1
    # Points that are a little coarser than the cells leave gaps between them; a neighbour's hit counts too.
    near = torch.nn.functional.max_pool2d(hits[None, None], 3, 1, 1)[0, 0]
    return _to_blocks(near[None])[0] > 0


def _discs(cells: _Cells) -> tuple[Tensor, Tensor, Tensor]:
    """Means, scales and quaternions of a thin disc on the surface for each cell."""
    length_x = cells.along_x.norm(dim=-1, keepdim=True)
    axis_x = cells.along_x / length_x
    axis_y = torch.linalg.cross(cells.normal, axis_x)
    length_y = (cells.along_y * axis_y).sum(-1, keepdim=True).abs()
    rotation = torch.stack([axis_x, axis_y, cells.normal], -1)
    scales = torch.cat([FILL * length_x, FILL * length_y, THICKNESS * cells.footprint[..., None]], -1)
    return cells.point, scales, matrix_to_quaternion(rotation)


def _patch_positions(cameras: Cameras, depth: Tensor, patch: int) -> Float[Tensor, "tokens 3"]:
    """World position of the middle of every patch, view by view, row by row."""
    middle = patch // 2
    z = depth[:, middle::patch, middle::patch]
    rows = torch.arange(z.shape[1]) * patch + middle + 0.5
    columns = torch.arange(z.shape[2]) * patch + middle + 0.5
    return cameras.unproject(z, columns, rows).reshape(-1, 3)


def _neighbours(points: Tensor, spacing: Tensor, rows: Tensor, near: int) -> Neighbours:
    distance, index = cKDTree(rows.double().numpy()).query(points.double().numpy(), k=min(near, len(rows)))
    relative = torch.from_numpy(distance.reshape(len(points), -1)).to(spacing.dtype) / spacing[:, None]
    bias = -DISTANCE_PENALTY * relative.square().clamp_max(4)
    return Neighbours(torch.from_numpy(index.reshape(len(points), -1)), bias)
