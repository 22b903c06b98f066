"""Photos with cameras become one scene, region by region."""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from querysplat_cli.encoders.base import Encoder, Geometry, PosedViews
from querysplat_cli.pipeline.build import BuiltScene, distinct_views
from querysplat_cli.pipeline.full_size import FullSize, LargePhotos
from querysplat_cli.pipeline.kept_parts import read_part, write_part
from querysplat_cli.pipeline.policy import PIPELINE_POLICY
from querysplat_cli.pipeline.regions.colours import common_exposures, recoloured
from querysplat_cli.pipeline.regions.groups import Group, divide
from querysplat_cli.pipeline.regions.merge import (
    merged_anchors,
    merged_gaussians,
    merged_kept,
    merged_map,
    merged_memories,
)
from querysplat_cli.pipeline.regions.owners import CoreViews, owners, small_cameras
from querysplat_cli.pipeline.regions.scene import RegionScene
from querysplat_cli.pipeline.regions.seams import disagreement, find_seams, smoothed
from querysplat_cli.pipeline.regions.task import SCENE, TASK, region_maker, region_task
from querysplat_cli.pipeline.settings import ReconstructSettings
from querysplat_cli.pipeline.unfinished import Unfinished
from querysplat_cli.queries.backdrop import shows_background
from querysplat_cli.queries.prepare import PreparedQueries
from querysplat_cli.reporting.report import Report, tto_entries
from querysplat_cli.reporting.view_scores import score
from querysplat_cli.runtime import signals
from querysplat_cli.runtime.engine import Engine
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.progress import StageProgress, Stages
from querysplat_cli.scene.exposures import Exposures
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.photo_files import photo_files
from querysplat_cli.scene.views import PhotoSource
from querysplat_cli.tto.adapt import Adapted
from querysplat_cli.tto.exposure_fit import PhotoColours


@dataclass(frozen=True)
class BuiltRegions:
    """A scene of several regions, and its entries in the report.

    regions, seams: one entry each. peak_gib: the most memory of any process that made a region.
    """

    scene: BuiltScene
    regions: list[dict[str, Any]]
    seams: list[dict[str, Any]]
    warnings: tuple[str, ...]
    peak_gib: float

    def added_to(self, report: Report) -> Report:
        """The report of the scene with these entries."""
        return replace(
            report,
            regions=self.regions,
            seams=self.seams,
            warnings=[*report.warnings, *self.warnings],
            peak_memory_gib=round(max(self.peak_gib, report.peak_memory_gib), 2),
        )


def region_count(settings: ReconstructSettings, photos: int, encoder: Encoder) -> int:
    """How many regions so many photos become.

    Raises QuerySplatError where --regions cannot be had: too few photos, an encoder whose depth needs all photos at
    once, or another option that is for one region alone.
    """
    wanted, asked = settings.regions, f"--regions {settings.regions}"
    alone = encoder.own_frame or settings.budget is not None or bool(settings.refine_cameras)
    if wanted is None:
        return 1 if alone else -(-photos // PIPELINE_POLICY.region_photos)
    if wanted == 1:
        return 1
    if encoder.own_frame:
        raise QuerySplatError(
            f"{asked}: the encoder {encoder.name} takes all photos at once", "Use --encoder classical."
        )
    if alone:
        raise QuerySplatError(f"{asked}: --budget and --refine-cameras are for one region", "Leave one of them out.")
    most = photos // PIPELINE_POLICY.fewest_region_photos
    if wanted > most:
        raise QuerySplatError(
            f"{asked}: {photos} photos with cameras are too few", f"Use at most {max(1, most)}, or leave it out."
        )
    return wanted


def build_regions(
    posed: PosedViews,
    count: int,
    settings: ReconstructSettings,
    sources: Mapping[str, PhotoSource],
    work: Unfinished,
    engine: Engine,
    stages: Stages,
) -> BuiltRegions:
    """Divide the photos, let `engine` make the regions in the folders of `work`, and join them.

    Raises QuerySplatError where Ctrl-C stopped it; the regions that are done stay in the folders.
    """
    with stages("regions"):
        posed, duplicates = (posed, ()) if settings.keep_everything else distinct_views(posed)
        groups = divide(posed, count)
        folders = [work.region(number) for number in range(1, count + 1)]
        for folder, group in zip(folders, groups, strict=True):
            if not (folder / TASK).is_file():
                write_part(folder / TASK, region_task(posed, group, settings, sources))
    try:
        _carry_out(folders, engine, stages)
    except KeyboardInterrupt:
        done = sum((folder / SCENE).is_file() for folder in folders)
        raise QuerySplatError(
            f"stopped: {done} of {count} regions are done", "The same command goes on with the others.",
            signals.exit_code(),
        ) from None  # fmt: skip
    scenes = [_read(folder / SCENE) for folder in folders]
    with stages("join") as progress:
        joint = _Joint.of(posed, groups, scenes)
        files = photo_files(posed.views.names, posed.photo_cameras, sources)
        photos = LargePhotos(posed.views, posed.cameras, files, joint.exposures)
        seams, warnings = _seams(groups, joint, posed)
        size = max(scene.size for scene in scenes)
        gaussians, runs = joint.gaussians, [entry for scene in scenes for entry in scene.entries["tto"]]
        for number, seam in enumerate(find_seams(groups)):
            part = partial(_part, progress, number / len(seams), 1 / len(seams))
            gaussians, run, result = smoothed(seam, photos, size, gaussians, seed=settings.seed, progress=part)
            (entry,) = tto_entries([(run, result)])
            runs.append({**entry, "max_size": size})
        scene = _scene(posed, joint, scenes, groups)
        summary: dict[str, Any] = next((each.entries["full_size"] for each in scenes if each.entries["full_size"]), {})
        further = FullSize(gaussians, size, runs, summary, False, joint.exposures)
        scene = replace(scene, files=files, duplicates=duplicates, full_size=further)
        if settings.backdrop and scene.prepared.anchors is not None and shows_background(posed.views):
            scene = replace(scene, backdrop=photos.backdrop(gaussians))
    peak = max(each.entries.pop("process_peak_gib") for each in scenes)
    regions = [
        {
            "photos": len(group.core),
            "overlap": len(group.overlap),
            "gaussians": int(own.sum()),
            **_brief(each, posed, group, gaussians),
        }
        for group, own, each in zip(groups, joint.own, scenes, strict=True)
    ]
    return BuiltRegions(scene, regions, seams, warnings, peak)


def _carry_out(folders: Sequence[Path], engine: Engine, stages: Stages) -> None:
    """Let `engine` make all regions; each is a stage of the name of its folder."""
    with ExitStack() as stack:
        shown: dict[Path, tuple[ExitStack, StageProgress]] = {}
        over: set[Path] = set()

        def heard(folder: Path, text: str, fraction: float) -> None:
            if folder not in shown:
                stage = stack.enter_context(ExitStack())
                shown[folder] = stage, stage.enter_context(stages(folder.name))
            if folder not in over:
                shown[folder][1](text, fraction)

        def done(folder: Path, why: str | None) -> None:
            over.add(folder)
            if folder in shown:
                shown[folder][0].close()
            if why:
                raise QuerySplatError(f"{folder.name}: {why}", "The same command goes on with what is missing.")

        engine.run(region_maker, None, folders, done, heard)


@dataclass(frozen=True)
class _Joint:
    """Regions in common colours: whole, which of their Gaussians stay, and those as one scene."""

    whole: list[Gaussians]
    own: list[torch.Tensor]
    gaussians: Gaussians
    exposures: Exposures | None

    @classmethod
    def of(cls, posed: PosedViews, groups: Sequence[Group], scenes: Sequence[RegionScene]) -> "_Joint":
        exposures, transforms = common_exposures(groups, scenes, len(posed.views))
        whole = [each.gaussians for each in scenes]
        if exposures:
            whole = [recoloured(each, transform) for each, transform in zip(whole, transforms, strict=True)]
        small = [small_cameras(posed.cameras[list(group.core)]) for group in groups]
        views = CoreViews.of([(cameras, each.depth) for cameras, each in zip(small, scenes, strict=True)])
        own = [owners(each.means, views) == number for number, each in enumerate(whole)]
        kept = [each[mine] for each, mine in zip(whole, own, strict=True)]
        return cls(whole, own, merged_gaussians(kept), exposures)


def _seams(groups: Sequence[Group], joint: _Joint, posed: PosedViews) -> tuple[list[dict[str, Any]], tuple[str, ...]]:
    """The entry of every seam, and a warning for each bad one."""
    entries, warnings = [], []
    for seam in find_seams(groups):
        decibels = disagreement(seam, posed.cameras, joint.whole)
        one, other = (number + 1 for number in seam.regions)
        entries.append({"regions": [one, other], "photos": len(seam.photos), "psnr": round(decibels, 2)})
        if decibels < PIPELINE_POLICY.bad_seam_psnr:
            warnings.append(
                f"regions {one} and {other} show different things where they meet ({decibels:.1f} dB): "
                "look at the scene there, and use fewer --regions"
            )
    return entries, tuple(warnings)


def _scene(posed: PosedViews, joint: _Joint, scenes: Sequence[RegionScene], groups: Sequence[Group]) -> BuiltScene:
    memories = merged_memories(scenes)
    prepared = PreparedQueries(memories, merged_anchors(scenes), None, merged_map(groups, scenes, len(posed.views)))
    kept = merged_kept(scenes, joint.own)
    adapted = Adapted(memories, joint.gaussians, posed.cameras, (), kept, exposures=joint.exposures)
    warnings = tuple(dict.fromkeys(line for each in scenes for line in each.entries["warnings"]))
    measured = [each.disagreement for each in scenes if each.disagreement is not None]
    same = joint.exposures or Exposures.identity(len(posed.views))
    colours = PhotoColours(same, max(measured)) if measured else None
    return BuiltScene(posed, Geometry(None, None, (), 1, warnings), prepared, adapted, colours=colours)


def _brief(each: RegionScene, posed: PosedViews, group: Group, gaussians: Gaussians) -> dict[str, Any]:
    """The rest of a region's entry; `joined` is the quality of the whole scene on the region's own photos."""
    core = list(group.core)
    joined = score(gaussians, posed.views[core], posed.cameras[core]).summary()
    entries = {name: value for name, value in each.entries.items() if name not in ("tto", "full_size", "warnings")}
    quality = {name: value for name, value in entries.pop("quality").items() if name not in ("views", "background")}
    return {**entries, "quality": quality, "joined": joined}


def _read(path: Any) -> RegionScene:
    scene: RegionScene | None = read_part(path)
    if scene is None:
        raise QuerySplatError(f"{path} is missing or damaged", "The same command makes it again.")
    return scene


def _part(progress: Any, start: float, share: float, text: str, fraction: float) -> None:
    progress(text, start + share * fraction)
