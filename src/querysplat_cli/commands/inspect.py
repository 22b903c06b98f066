"""What `inspect` does: draw the attention of a query, and the opacity, scale and place of the Gaussians."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from querysplat_cli.commands.query_figure import draw_query
from querysplat_cli.commands.requests import InspectRequest
from querysplat_cli.commands.samples import drawn_points, quantiles
from querysplat_cli.model.attention_maps import attention_of, valueless
from querysplat_cli.pipeline.gaussian_files import refuse_replacing_scene
from querysplat_cli.pipeline.read_scene import read_scene
from querysplat_cli.pipeline.resume import joined_of_regions, load_again
from querysplat_cli.pipeline.scene_folder import StoredScene
from querysplat_cli.pipeline.stored_gaussians import stored_gaussians
from querysplat_cli.queries.prepare import MemoryMap
from querysplat_cli.runtime.errors import MAKE_AGAIN, QuerySplatError
from querysplat_cli.runtime.figures import new_figure, save_figure
from querysplat_cli.runtime.progress import Stages
from querysplat_cli.scene.cameras import Cameras, project_points
from querysplat_cli.scene.files import FolderKind, atomic_folder, refuse_existing
from querysplat_cli.scene.gaussians import SH_0, Gaussians
from querysplat_cli.scene.pictures import write_picture
from querysplat_cli.scene.views import Views

TILE_COLUMNS = 4
"""Photos side by side in a picture of attention."""
RING_RADIUS = 12
"""In pixels, of the ring around a query's Gaussians."""
DRAWINGS = FolderKind(("attention_*.png",), ("query.png", "rounds.png", "histograms.png", "points.png"))
BEFORE = "the Gaussians were optimised themselves: the pictures of the query show those that it had before"
DRAWN_OPACITY = 0.05
"""Gaussians of less opacity are not drawn as points."""


@dataclass(frozen=True)
class Inspected:
    """What was drawn. `attention` has, for each memory, the share of the query's attention that each view gets.

    "special" is the share of tokens that belong to no patch. Shares of a memory sum to 1; with one branch, those of
    both memories do. `rounds` has the attention of the last round of refinement in the same way, where there was one;
    "nothing" is the share that went to no view. `opacity` and `scale` have quantiles. Each of `warnings` is a sentence
    on what the figures cannot show.
    """

    output: str
    query: int
    attention: dict[str, dict[str, float]]
    rounds: dict[str, dict[str, float]]
    opacity: dict[str, float]
    scale: dict[str, float]
    depth: bool
    warnings: tuple[str, ...] = ()


def inspect_scene(request: InspectRequest, stages: Stages) -> Inspected:
    """Draw the attention of a query (the most opaque one by default), histograms and points of a stored scene.

    Raises QuerySplatError when the scene has no such query, was stored without what the drawings need, or was made by a
    model without appearance blocks.
    """
    output = request.target
    refuse_replacing_scene(request.scene, output, instead="-attention")
    refuse_existing([output], force=request.force, kind=DRAWINGS)
    with stages("read"):
        scene, report = read_scene(request.scene)
        if scene.joined:
            raise joined_of_regions(request.scene, "Make the scene again with --regions 1.")
        model = load_again(scene, report["settings"], request.weights, torch.device("cpu"))
        if scene.map is None:
            raise QuerySplatError(f"{request.scene} was made by an earlier version", MAKE_AGAIN)
    with stages("attention"):
        with torch.no_grad():
            gaussians = model.decode(scene.memories, scene.anchors)
        kept = torch.ones(len(gaussians), dtype=torch.bool) if scene.kept is None else scene.kept
        count = len(gaussians) // model.config.gaussians_per_query
        by_query = (gaussians.opacities * kept).view(count, -1)
        chosen = int(by_query.sum(1).argmax()) if request.query is None else request.query
        if not 0 <= chosen < count:
            raise QuerySplatError(f"--query {chosen}: there are queries 0 to {count - 1}", "Choose one of them.")
        found = attention_of(model, scene.memories, scene.anchors, chosen)
        cameras = scene.cameras
        patches = (0, cameras.height // model.config.patch, cameras.width // model.config.patch)
        maps = {
            "geometry": on_patches(found.geometry, scene.map.geometry_rows, len(scene.views), scene.map.layout),
            "appearance": on_patches(found.appearance, scene.map.appearance_rows, len(scene.views), patches),
        }
        per_query = model.config.gaussians_per_query
        own = gaussians[slice(chosen * per_query, (chosen + 1) * per_query)]
        rounds = _rounds(scene, own, chosen, patches)
        # Memories do not know what became of Gaussians that were optimised themselves.
        apart = any(run["space"] == "gaussians" and run["steps"] for run in report["tto"])
        gaussians = stored_gaussians(request.scene, scene, report).own if apart else gaussians[kept]
    with stages("draw"), atomic_folder(output) as draft:
        _queries(draft, scene, maps, rounds, own)
        _histograms(draft / "histograms.png", gaussians)
        _points(draft / "points.png", scene, scene.map, gaussians)
    return Inspected(
        output=str(output),
        query=chosen,
        attention={
            "geometry": _shares(maps["geometry"], scene.views.names, float(found.geometry.sum())),
            "appearance": _shares(maps["appearance"], scene.views.names, float(found.appearance.sum())),
        },
        rounds={branch: _shares(weight, scene.views.names, 1.0, rest="nothing") for branch, weight in rounds.items()},
        opacity=quantiles(gaussians.opacities),
        scale=quantiles(gaussians.scales.flatten()),
        depth=scene.map.depth.numel() > 0,
        warnings=(BEFORE,) * apart
        + tuple(
            f"the values of the {name} memory are all zero: what the query attends to there changes nothing"
            for name in valueless(scene.memories)
        ),
    )


def on_patches(weights: Tensor, rows: Tensor, views: int, layout: tuple[int, int, int]) -> Tensor:
    """The weights of patches, [views, rows, columns], without those of special tokens.

    `rows` says which row of the whole memory each weight is of; `layout` is (special tokens, rows, columns)
    of a view's tokens.
    """
    special, height, width = layout
    whole = torch.zeros(views * (special + height * width)).index_put((rows.long(),), weights, accumulate=True)
    return whole.view(views, -1)[:, special:].view(views, height, width)


def _rounds(scene: StoredScene, own: Gaussians, query: int, layout: tuple[int, int, int]) -> dict[str, Tensor]:
    """What a query read in the last round by branch, as weights of patches [views, rows, columns]; {} without rounds.

    The row of a view belongs to the projection of the query's middle Gaussian, whose patch has its weight.
    """
    if scene.anchors is None or not scene.anchors.reading.views.shape[1]:
        return {}
    cameras, reading = scene.cameras, scene.anchors.reading
    _, rows, columns = layout
    views = reading.views[query].long()
    centre = own.means[len(own) // 2]
    pixels = torch.cat([project_points(centre[None], cameras.w2c[view], cameras.K[view]) for view in views.tolist()])
    column = (pixels[:, 0] * columns / cameras.width).long().clamp(0, columns - 1)
    row = (pixels[:, 1] * rows / cameras.height).long().clamp(0, rows - 1)
    patches = (views * rows + row) * columns + column
    weights = {"geometry": reading.geometry[query].float(), "appearance": reading.appearance[query].float()}
    return {branch: on_patches(each, patches, len(scene.views), layout) for branch, each in weights.items()}


def _shares(weight: Tensor, names: tuple[str, ...], whole: float, rest: str = "special") -> dict[str, float]:
    """By view, and the `rest` of the `whole` attention: to this memory's special tokens, or to nothing."""
    shares = {name: round(float(each), 5) for name, each in zip(names, weight.sum((1, 2)), strict=True)}
    return {**shares, rest: round(max(0.0, whole - float(weight.sum())), 5)}


def _queries(
    folder: Path, scene: StoredScene, maps: dict[str, Tensor], rounds: dict[str, Tensor], own: Gaussians
) -> None:
    """The pictures of the query's attention to both memories, and, where there were rounds, to their rows."""
    for branch, weight in maps.items():
        write_picture(folder / f"attention_{branch}.png", _overlays(scene.views, scene.cameras, weight, own))
    to_memories = {f"attention to the {branch} memory": weight for branch, weight in maps.items()}
    draw_query(folder / "query.png", scene.views, scene.cameras, to_memories, own)
    if rounds:
        to_rows = {f"last round: {branch} rows": weight for branch, weight in rounds.items()}
        draw_query(folder / "rounds.png", scene.views, scene.cameras, to_rows, own)


def _overlays(views: Views, cameras: Cameras, weight: Tensor, own: Gaussians) -> np.ndarray:
    """Photos, darkened and coloured by the weights, with a ring around the query's Gaussians, in rows of tiles."""
    heat = F.interpolate(weight[:, None], views.images.shape[-2:], mode="bilinear")[:, 0] / weight.max().clamp_min(
        1e-12
    )
    tiles = []
    for i, (height, width) in enumerate(views.sizes):
        photo = (views.images[i].permute(1, 2, 0) * 255).byte().numpy()
        colours = cv2.applyColorMap((heat[i] * 255).byte().numpy(), cv2.COLORMAP_INFERNO)[..., ::-1]
        share = heat[i, ..., None].sqrt().numpy()
        tile = np.ascontiguousarray((photo * (1 - 0.7 * share) + colours * 0.7 * share).astype(np.uint8))
        centres = _projected(own, cameras, i)
        if centres:
            x, y = np.median(centres, 0)
            cv2.circle(tile, (round(x), round(y)), RING_RADIUS, (0, 255, 120), 1, cv2.LINE_AA)
        tile[height:], tile[:, width:] = 255, 255
        tiles.append(tile)
    tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % min(TILE_COLUMNS, len(tiles)))
    across = min(TILE_COLUMNS, len(tiles))
    return np.vstack([np.hstack(tiles[start : start + across]) for start in range(0, len(tiles), across)])


def _projected(own: Gaussians, cameras: Cameras, view: int) -> list[tuple[float, float]]:
    """Pixels of the centres that lie in front of the camera and in the picture."""
    pixels = project_points(own.means[cameras.sees(own.means, view)], cameras.w2c[view], cameras.K[view])
    return [(float(x), float(y)) for x, y in pixels]


def _histograms(path: Path, gaussians: Gaussians) -> None:
    figure = new_figure(9.0, 3.2)
    left, right = figure.subplots(1, 2)
    left.hist(gaussians.opacities.numpy(), bins=50, range=(0, 1), color="tab:blue")
    left.set(xlabel="opacity", ylabel="Gaussians", yscale="log")
    scales = gaussians.scales.clamp_min(1e-8).log10().numpy()
    for axis, values in zip(("x", "y", "z"), scales.T, strict=True):
        right.hist(values, bins=50, histtype="step", label=axis)
    right.set(xlabel="log₁₀ scale, scene units")
    right.legend()
    save_figure(figure, path)


def _points(path: Path, scene: StoredScene, found: MemoryMap, gaussians: Gaussians) -> None:
    """The points of the VGM's depth, if it was estimated, beside the Gaussians' centres, from one viewpoint."""
    shown = gaussians[gaussians.opacities >= min(DRAWN_OPACITY, float(gaussians.opacities.max()))]
    colours = (shown.sh[:, 0] * SH_0 + 0.5).clamp(0, 1)
    panels = [("centres of Gaussians", shown.means, colours)]
    if found.depth.numel():
        cameras, views = scene.cameras, scene.views
        y, x = (torch.arange(side) + 0.5 for side in found.depth.shape[1:])
        points = cameras.unproject(found.depth.float(), x, y)[views.masks]
        panels.insert(0, ("depth", points, views.images.permute(0, 2, 3, 1)[views.masks]))
    figure = new_figure(6.0 * len(panels), 6.0)
    # Outliers would make everything else small.
    low, high = (np.quantile(panels[0][1].numpy(), level, 0).tolist() for level in (0.02, 0.98))
    high = [max(top, bottom + 1e-3) for bottom, top in zip(low, high, strict=True)]  # one photo's scene is flat
    for i, (name, points, colour) in enumerate(panels):
        some = drawn_points(len(points))
        axes = figure.add_subplot(1, len(panels), i + 1, projection="3d")
        x, y, z = points[some].T.numpy()
        axes.scatter(x, z, -y, c=colour[some].numpy(), s=1)
        axes.set(title=f"{name} ({len(points):,})", xlabel="x", ylabel="z", zlabel="−y")
        axes.set(xlim=(low[0], high[0]), ylim=(low[2], high[2]), zlim=(-high[1], -low[1]))
        axes.view_init(elev=25, azim=-70)
    save_figure(figure, path)
