"""Where anchored queries stand: points spread over the VGM's point cloud, with a prior for each Gaussian.

The pictures are cut into square blocks, one query each, and every block into 3 × 3 cells, one Gaussian
each. Views come one after another: a block whose surface the blocks kept so far cover about as finely is left
out, and so is one that stands in front of surfaces which other views see with confidence.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.views import Views

CELLS = 3
"""Cells along a block's side; a query owns CELLS² Gaussians."""
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
DISTANCE_PENALTY = 2.0
"""Attention logit lost per squared distance, in spacings, between a query and a memory row."""
FEATURES = 10 + 10 * CELLS**2
"""Numbers that describe an anchor as it is built: those of its block, then those of its cells."""
BORDER = 4
"""Blocks from the picture's border within which an anchor knows how near it is."""


@dataclass(frozen=True)
class Neighbours:
    """The rows of a memory that each query may attend to.

    `bias` is added to the attention logits (a penalty on distance), the same for all heads.
    """

    index: Int[Tensor, "queries near"]
    bias: Float[Tensor, "queries near"]


@dataclass(frozen=True)
class Anchors:
    """Q anchored queries of G Gaussians each, in world coordinates.

    The prior (`means`, `scales`, `quats` w x y z, `opacities`, `colours` in [0, 1]) is the scene before any
    decoder has spoken; heads predict changes to it, lengths in units of `spacing`. `features` feed the query
    embedding; none of them depends on the scene's frame. `geometry`, `appearance` and `queries` say which rows
    of the two memories, and which other queries, each query attends to.
    """

    means: Float[Tensor, "queries gaussians 3"]
    scales: Float[Tensor, "queries gaussians 3"]
    quats: Float[Tensor, "queries gaussians 4"]
    opacities: Float[Tensor, "queries gaussians"]
    colours: Float[Tensor, "queries gaussians 3"]
    spacing: Float[Tensor, "queries"]
    features: Float[Tensor, "queries channels"]
    geometry: Neighbours
    appearance: Neighbours
    queries: Neighbours

    def __len__(self) -> int:
        return len(self.means)


@dataclass(frozen=True)
class AnchorReport:
    """How many blocks the pictures have, and why some carry no query."""

    blocks: int
    kept: int
    redundant: int
    hiding: int
    empty: int


def build_anchors(
    views: Views,
    cameras: Cameras,
    depth: Float[Tensor, "views height width"],
    confidence: Float[Tensor, "views height width"],
    *,
    patch: int,
    queries: int | None = None,
    near: int = 4,
    everything: bool = False,
) -> tuple[Anchors, AnchorReport]:
    """Anchored queries for a scene whose depth (camera z, scene units) is known.

    Memory rows are the patches of `patch` pixels, view by view, row by row; each query attends to the
    `near` nearest of them in space. `queries` limits their number by cutting the pictures more coarsely;
    None keeps a block for each patch that shows something no other view shows as well, or, with `everything`,
    for each patch.
    """
    block = 2 * CELLS
    while True:
        cells = _cells(views, cameras, depth, confidence, block // CELLS)
        seen = _compare_views(cells, views, cameras, depth, confidence)
        keep, report = _choose_blocks(cells, seen, cameras, block // CELLS, everything)
        if queries is None or report.kept <= queries:
            break
        block += CELLS
    colours = seen.colour.reshape(-1, CELLS**2, 3)[keep]
    means, scales, quats = (part.reshape(-1, CELLS**2, part.shape[-1])[keep] for part in _discs(cells))
    trusted = cells.confidence.reshape(-1, CELLS**2)[keep]
    visible = cells.valid.reshape(-1, CELLS**2)[keep]
    opacities = torch.where(visible, 0.6 + 0.35 * trusted, 0.01)
    spacing = (cells.footprint * CELLS).reshape(-1, CELLS**2).mean(1)[keep]
    centres = means[:, CELLS**2 // 2]
    tokens = _patch_positions(cameras, depth, patch)
    memory = _neighbours(centres, spacing, tokens, near)
    anchors = Anchors(
        means=means,
        scales=scales,
        quats=quats,
        opacities=opacities,
        colours=colours,
        spacing=spacing,
        features=_features(cells, seen)[keep],
        geometry=memory,
        appearance=memory,
        queries=_neighbours(centres, spacing, centres, near),
    )
    return anchors, report


@dataclass(frozen=True)
class _Cells:
    """Every cell of every block of every view: [views, rows, columns, 9, …]."""

    point: Float[Tensor, "views rows columns cells 3"]
    depth: Float[Tensor, "views rows columns cells"]
    footprint: Float[Tensor, "views rows columns cells"]
    confidence: Float[Tensor, "views rows columns cells"]
    colour: Float[Tensor, "views rows columns cells 3"]
    valid: Bool[Tensor, "views rows columns cells"]
    along_x: Float[Tensor, "views rows columns cells 3"]
    along_y: Float[Tensor, "views rows columns cells 3"]
    normal: Float[Tensor, "views rows columns cells 3"]
    origin: Float[Tensor, "views rows columns cells 3"]


@dataclass(frozen=True)
class _Seen:
    """What the other views say of each cell."""

    hiding: Bool[Tensor, "views rows columns cells"]
    colour: Float[Tensor, "views rows columns cells 3"]
    supporters: Float[Tensor, "views rows columns cells"]
    hidden: Float[Tensor, "views rows columns cells"]


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


def _features(cells: _Cells, seen: _Seen) -> Float[Tensor, "blocks channels"]:
    """What is known of each block before anything is read or rendered, each number about 1 in size.

    Of the block: mean colour, confidence, size, slant, and how near the picture's four borders are. Of its cells:
    colour and what the other views add to it, confidence, depth, how many views agree with it and how many it hides.
    """
    views, rows, columns, _ = cells.depth.shape
    mean = seen.colour.mean(3, keepdim=True)
    spacing = CELLS * cells.footprint.mean(3, keepdim=True)
    ray = torch.nn.functional.normalize(cells.point - cells.origin, dim=-1)
    slant = (cells.normal * ray).sum(-1).abs().mean(3, keepdim=True)
    row, column = torch.arange(rows).float(), torch.arange(columns).float()
    sides = torch.broadcast_tensors(
        row[:, None], rows - 1 - row[:, None], column.expand(rows, columns), columns - 1 - column.expand(rows, columns)
    )
    border = (torch.stack(sides, -1) / BORDER).clamp_max(1).expand(views, rows, columns, 4)
    # Relative to the others: the pictures' size and the scene's say nothing about a block.
    size = spacing.log() - spacing.log().median()
    whole = (mean[..., 0, :] - 0.5, cells.confidence.mean(3, keepdim=True), size, slant, border)
    relative = (cells.depth - cells.depth.median(3, keepdim=True).values) / spacing
    apart = (
        4 * (seen.colour - mean).flatten(3),
        4 * (cells.colour - seen.colour).flatten(3),
        cells.confidence,
        relative.clamp(-2, 2),
        (seen.supporters / 2).clamp_max(2),
        (seen.hidden / 2).clamp_max(2),
    )
    return torch.cat([*whole, *apart], -1).flatten(0, 2)


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
    fx, fy, cx, cy = _intrinsics(cameras)
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
            local = points @ cameras.w2c[other, :3, :3].T + cameras.w2c[other, :3, 3]
            z = local[:, 2].clamp_min(1e-6)
            x = local[:, 0] / z * fx[other] + cx[other]
            y = local[:, 1] / z * fy[other] + cy[other]
            inside = (local[:, 2] > 1e-6) & (x >= 0) & (y >= 0) & (x < cameras.width) & (y < cameras.height)
            column = x.clamp(0, cameras.width - 1).long()
            row = y.clamp(0, cameras.height - 1).long()
            inside &= views.masks[other, row, column]
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


def _choose_blocks(
    cells: _Cells, seen: _Seen, cameras: Cameras, cell: int, everything: bool
) -> tuple[Bool[Tensor, "blocks"], AnchorReport]:
    empty = cells.valid.float().mean(-1) <= 0.5
    if everything:
        shown = int((~empty).sum())
        return ~empty.flatten(), AnchorReport(empty.numel(), shown, 0, 0, empty.numel() - shown)
    hiding = ~empty & (seen.hiding.float().mean(-1) > 0.5)
    keep = torch.zeros_like(empty)
    for own in range(len(cameras)):
        points, footprint = cells.point[keep].reshape(-1, 3), cells.footprint[keep].reshape(-1)
        covered = _covered(cells, cameras, own, cell, points, footprint)
        keep[own] = ~empty[own] & ~hiding[own] & (covered.float().mean(-1) < COVERED)
    redundant = ~empty & ~hiding & ~keep
    counts = (int(part.sum()) for part in (keep, redundant, hiding, empty))
    return keep.flatten(), AnchorReport(keep.numel(), *counts)


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
    return cells.point, scales, quaternions(rotation)


def quaternions(rotation: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4"]:
    """Unit quaternions w, x, y, z of rotation matrices, exact to rounding at every angle.

    Of the four classical formulas the one with the largest divisor is taken, so nothing is divided by
    less than 1/2 (Shepperd 1978).
    """
    m = rotation
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    squares = torch.stack([1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz], -1)
    a, b, c = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    d, e, f = m[..., 1, 0] + m[..., 0, 1], m[..., 0, 2] + m[..., 2, 0], m[..., 2, 1] + m[..., 1, 2]
    candidates = torch.stack(
        [
            torch.stack([squares[..., 0], a, b, c], -1),
            torch.stack([a, squares[..., 1], d, e], -1),
            torch.stack([b, d, squares[..., 2], f], -1),
            torch.stack([c, e, f, squares[..., 3]], -1),
        ],
        -2,
    )
    best = squares.argmax(-1)[..., None, None].expand(*squares.shape[:-1], 1, 4)
    return torch.nn.functional.normalize(candidates.gather(-2, best).squeeze(-2), dim=-1)


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
