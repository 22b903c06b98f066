"""What `convert` does with Gaussians: cleaned, turned, scaled, cut and pruned on the way, with the cost of all that."""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor

from querysplat_cli.commands.compared_views import ComparedViews, cameras_beside, compared_views
from querysplat_cli.commands.convert_levels import levels_entry, write_levels
from querysplat_cli.commands.convert_request import Conversion
from querysplat_cli.commands.edits import Step, edited
from querysplat_cli.commands.moved_folder import Moved, write_moved_folder
from querysplat_cli.pipeline.first_sight import upright_frame
from querysplat_cli.pipeline.gaussian_files import (
    FLIPPED,
    STREAMED,
    WRITERS,
    bytes_of,
    check_target,
    folder_of_scene,
    read_gaussians,
    write_gaussians,
)
from querysplat_cli.pipeline.scene_folder import SCENE_FOLDER, keep_others
from querysplat_cli.reporting.omissions import by_conversion, of_kind
from querysplat_cli.reporting.stored_report import backdrop_of
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.limits import check_address_space
from querysplat_cli.runtime.progress import Stages
from querysplat_cli.runtime.words import counted
from querysplat_cli.scene.files import atomic_together, refuse_existing
from querysplat_cli.scene.formats.compressed import FARTHEST_COORDINATE, moved_to_border
from querysplat_cli.scene.formats.mesh import MESH_KINDS, check_mesh_parts, write_mesh
from querysplat_cli.scene.formats.point_cloud import points_of, write_points
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.rotations import skew
from querysplat_cli.scene.sim3 import Sim3
from querysplat_cli.splat.fusion import fused
from querysplat_cli.splat.transform import transform_gaussians

DOWN = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
"""In files of Gaussians."""


@dataclass(frozen=True)
class _Edited:
    """A source, and what a request makes of it.

    `here` are its Gaussians in the frame of `views`, and `placed` in that of the target, which `place` maps to. Those
    that are `kept` stay, and those of `body` are no backdrop. `levels` has the PSNR (dB) before the `steps`, and after
    each of them.
    """

    here: Gaussians
    placed: Gaussians
    place: Sim3
    views: ComparedViews
    kept: Bool[Tensor, "n"]
    body: Bool[Tensor, "n"]
    steps: list[Step]
    levels: list[float]

    @property
    def result_views(self) -> ComparedViews:
        return replace(self.views, frame=self.place.after(self.views.frame))

    @property
    def entries(self) -> list[dict[str, Any]]:
        """What each step left out, and what it cost."""
        return [step.entry(level) for step, level in zip(self.steps, self.levels, strict=False)]


def convert_gaussians(request: Conversion, stages: Stages) -> dict[str, Any]:
    """Write the Gaussians, and the scene folder beside them where they are turned, scaled or cut.

    Returns the dict that --json prints. Raises QuerySplatError, and writes nothing, on bad input.
    """
    _check_kind(request)
    folder = _folder(request)
    with stages("read"):
        gaussians = read_gaussians(request.source)
        source_size = bytes_of(request.source)  # the target may replace it
        views = compared_views(request.source, gaussians)
    with stages("edit"):
        found = _edited(request, gaussians, views)
    with ExitStack() as stack:
        drafts = stack.enter_context(atomic_together(request.target, *([folder] if folder else [])))
        written, after = _write(drafts[0], request, found, stages)
        size = bytes_of(drafts[0])
        warnings = [_at_border(moved)] if (moved := written.get("at_border")) else []
        if folder:
            with stages("score"):
                warnings += _write_folder(drafts, request, found, after)
                keep_others(folder, drafts[1])
    return {
        "target": str(request.target),
        "scene": str(folder) if folder else None,
        **written,
        "left_out": len(gaussians) - written["gaussians"],
        "bytes": {"source": source_size, "target": size},
        "steps": [{**step, "against": views.kind} for step in found.entries],
        "psnr": None if request.geometry else _psnr_entry(views, found.levels[0], after),
        "warnings": warnings,
    }


def _at_border(moved: int) -> str:
    who = f"{counted(moved, 'Gaussian')} beyond ±{FARTHEST_COORDINATE:,}, where an .spz ends, moved to there"
    return f"{who}: write another kind of file, or use --scale or --crop"


def _edited(request: Conversion, gaussians: Gaussians, views: ComparedViews) -> _Edited:
    place = Sim3(request.scale, _turn(request, gaussians), torch.zeros(3).double())
    backdrop = backdrop_of(folder_of_scene(request.source), len(gaussians))
    here = views.here(gaussians)
    before = views.psnr(here)
    kept, steps = edited(request, here, place.apply(gaussians.means), backdrop, views)
    placed = transform_gaussians(gaussians, place) if place.scale != 1.0 or request.up else gaussians
    body = kept & (torch.arange(len(kept)) < len(kept) - backdrop)
    return _Edited(here, placed, place, views, kept, body, steps, [before, *(step.psnr for step in steps)])


def _write(path: Path, request: Conversion, found: _Edited, stages: Stages) -> tuple[dict[str, Any], float]:
    """Write the target to `path`; returns what is in it, and its PSNR, which a cloud or a mesh has from the edits."""
    views = found.result_views
    if request.points:
        return _write_cloud(path, found.placed[found.body]), found.levels[-1]
    if request.mesh:
        return _write_surface(path, request.source, found.here[found.body], views, stages), found.levels[-1]
    if request.target.suffix.lower() == STREAMED:
        with stages("levels"):
            write_levels(path, found.placed[found.kept], int((found.kept & ~found.body).sum()), request.levels)
            written = levels_entry(path, views)
        return written, written["levels"][0]["psnr"]
    with stages("write"):
        kept = found.placed[found.kept]
        count = write_gaussians(path, kept, request.spz_version)
        written = {"gaussians": count, "at_border": moved_to_border(path, kept)}
        return written, views.psnr(views.here(read_gaussians(path)))


def _write_folder(drafts: Sequence[Path], request: Conversion, found: _Edited, after: float) -> list[str]:
    """Write the scene's folder for the Gaussians in the first draft, whose PSNR is `after`, to the second one.

    Returns warnings as `write_moved_folder`.
    """
    bands = found.here.sh.shape[1]
    gone = [by_conversion(step["what"], step["gaussians"], bands, step["lost"]) for step in found.entries]
    if request.target.suffix.lower() in WRITERS:
        gone += of_kind(drafts[0], found.placed[found.kept], round(found.levels[-1] - after, 3))
    written = found.result_views.here(read_gaussians(drafts[0]))
    moved = Moved(request.target, found.place, found.kept, written, bytes_of(drafts[0]), gone)
    return write_moved_folder(folder_of_scene(request.source), drafts[1], moved)


def _check_kind(request: Conversion) -> None:
    """Raise QuerySplatError unless the target can be written as what is asked for."""
    kind = request.target.suffix.lower()
    if request.levels and kind != STREAMED:
        raise QuerySplatError("--levels is for levels of detail", f"Choose a target that ends in {STREAMED}.")
    if request.points and request.mesh:
        raise QuerySplatError("--points and --mesh are two files", "Write one after the other.")
    if request.points and kind != ".ply":
        raise QuerySplatError(f"{request.target}: points are written as .ply", "Choose a target that ends in .ply.")
    if request.mesh:
        if kind not in MESH_KINDS:
            raise QuerySplatError(f"{request.target}: not a kind of file for meshes", f"Use {', '.join(MESH_KINDS)}.")
        check_address_space("convert --mesh")
        check_mesh_parts()
    elif kind in MESH_KINDS and kind not in WRITERS:
        raise QuerySplatError(f"{request.target}: an {kind} holds a mesh", "Add --mesh to make one of the scene.")
    elif kind != STREAMED:
        check_target(request.target)


def _write_cloud(path: Path, gaussians: Gaussians) -> dict[str, int]:
    cloud = points_of(gaussians)
    if not len(cloud):
        raise QuerySplatError("the scene has no Gaussian, so there is no point", "Convert without --points.")
    write_points(path, cloud)
    return {"gaussians": len(cloud), "points": len(cloud)}


def _write_surface(path: Path, source: Path, here: Gaussians, views: ComparedViews, stages: Stages) -> dict[str, int]:
    """Fuse the Gaussians `here`, in the frame of the `views` of the mesh."""
    beside = cameras_beside(source)
    cameras, sizes = (beside[0].cameras, beside[0].sizes) if beside else (views.cameras, views.pictures.sizes)
    with stages("mesh") as progress:
        found = fused(here, cameras, sizes, progress)
    mesh = replace(found, places=views.frame.apply(torch.from_numpy(found.places)).numpy())
    write_mesh(path, mesh)
    return {"gaussians": len(here), "corners": len(mesh.places), "triangles": len(mesh.triangles)}


def _psnr_entry(views: ComparedViews, before: float, after: float) -> dict[str, Any]:
    return {
        "views": len(views),
        "against": views.kind,
        "before": round(before, 3),
        "after": round(after, 3),
        "lost": round(before - after, 3),
    }


def _folder(request: Conversion) -> Path | None:
    """Where the scene's folder is written as well. Raises QuerySplatError where something else is."""
    source, target = folder_of_scene(request.source), folder_of_scene(request.target)
    if not (source / "cameras.json").is_file() or not request.changes or request.geometry:
        return None
    if target.resolve() == source.resolve():
        raise QuerySplatError(
            f"{source} is the folder of {request.source}, and a changed scene needs one of its own",
            "Choose another name for TARGET.",
        )
    refuse_existing([target], force=request.force, kind=SCENE_FOLDER)
    return target


def _turn(request: Conversion, gaussians: Gaussians) -> torch.Tensor:
    """The rotation that --up asks for."""
    if request.up is None:
        return torch.eye(3, dtype=torch.float64)
    if request.up != "auto":
        return upright(torch.tensor(request.up, dtype=torch.float64))
    beside = cameras_beside(request.source)
    if beside is None:
        raise QuerySplatError(
            f"--up auto: {folder_of_scene(request.source)} has no cameras.json, and cameras tell what is up",
            "Give the direction that points up in the scene, for instance --up z or --up=0,-1,0.2.",
        )
    inputs, frame = beside
    return upright_frame(gaussians, inputs.cameras.transformed(frame)).rotation


def upright(up: torch.Tensor) -> torch.Tensor:
    """The smallest rotation [3, 3] that takes the direction `up` to −y. From y it is half a turn about x."""
    up = up / up.norm()
    cosine = -float(up @ DOWN)
    if cosine < -1 + 1e-9:
        return FLIPPED.rotation
    turn = skew(torch.linalg.cross(up, -DOWN)[None])[0]
    return torch.eye(3, dtype=torch.float64) + turn + turn @ turn / (1 + cosine)
