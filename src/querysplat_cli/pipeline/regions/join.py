"""The scenes of regions become one."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from statistics import median
from typing import Any, cast

import torch
from jaxtyping import Bool

from querysplat_cli.encoders.base import Geometry, PosedViews, UsedDepthMaps
from querysplat_cli.model.memories import Memories
from querysplat_cli.pipeline.build import BuiltScene
from querysplat_cli.pipeline.full_size import FullSize, LargePhotos
from querysplat_cli.pipeline.policy import PIPELINE_POLICY
from querysplat_cli.pipeline.regions.colours import common_exposures, recoloured
from querysplat_cli.pipeline.regions.groups import Group, divide
from querysplat_cli.pipeline.regions.owners import CoreViews, owners, small_cameras
from querysplat_cli.pipeline.regions.scene import KeptRegions, RegionScene
from querysplat_cli.pipeline.regions.seams import Seam, disagreement, find_seams, parts_needed, smoothed, verdict
from querysplat_cli.pipeline.settings import ReconstructSettings
from querysplat_cli.queries.backdrop import shows_background
from querysplat_cli.reporting.report import Report, tto_entries
from querysplat_cli.reporting.view_scores import Quality
from querysplat_cli.runtime.progress import Progress
from querysplat_cli.scene.exposures import Exposures
from querysplat_cli.scene.gaussians import Gaussians, joined
from querysplat_cli.scene.masks import MaskedShare
from querysplat_cli.scene.photo_files import photo_files
from querysplat_cli.scene.views import PhotoSource, Views
from querysplat_cli.tto.adapt import Adapted
from querysplat_cli.tto.exposure_fit import PhotoColours

IN_THE_WHOLE = ("tto", "full_size", "warnings", "depth_maps")
"""Entries of regions that the report has for all of them together."""


@dataclass(frozen=True)
class BuiltRegions:
    """A scene of several regions, and its entries in the report.

    regions, seams: one entry each. own: the names of each region's own photos. peak_gib: the most memory of any process
    that made a region.
    """

    scene: BuiltScene
    regions: list[dict[str, Any]]
    own: list[tuple[str, ...]]
    seams: list[dict[str, Any]]
    warnings: tuple[str, ...]
    peak_gib: float

    def added_to(self, report: Report, inputs: Quality) -> Report:
        """The report of the scene with these entries. `inputs` is the quality of the whole scene on all photos."""
        joined = [inputs.of(names).summary() for names in self.own]
        regions = [{**entry, "joined": scores} for entry, scores in zip(self.regions, joined, strict=True)]
        return replace(
            report,
            regions=regions,
            seams=self.seams,
            warnings=[*report.warnings, *self.warnings, *worse_joined(regions)],
            peak_memory_gib=round(max(self.peak_gib, report.peak_memory_gib), 2),
        )


def worse_joined(regions: Sequence[dict[str, Any]]) -> list[str]:
    """A warning where the whole scene shows photos of regions much worse than these regions alone did.

    Something of another region stands there then, as where cameras of different places lie on top of each other.
    """
    lost = {n: each["quality"]["psnr"] - each["joined"]["psnr"] for n, each in enumerate(regions, 1)}
    bad = [str(number) for number, decibels in lost.items() if decibels > PIPELINE_POLICY.lost_by_joining]
    if not bad:
        return []
    which = f"region {bad[0]}" if len(bad) == 1 else f"regions {', '.join(bad)}"
    most = max(lost.values())
    return [
        f"the joined scene shows photos of {which} up to {most:.1f} dB worse than the region alone: "
        "cameras of different places may lie on top of each other"
    ]


def join(
    posed: PosedViews,
    groups: Sequence[Group],
    kept: KeptRegions,
    settings: ReconstructSettings,
    sources: Mapping[str, PhotoSource],
    progress: Progress,
) -> BuiltRegions:
    """One scene of the regions of `groups`, optimised as a whole, with a backdrop behind it.

    Beside the joint scene, the Gaussians of two regions are in memory at a time, and then the photos of one part of the
    last optimisation. Raises ImpossibleScene where regions do not fit together, and KeyboardInterrupt where Ctrl-C
    ended that optimisation.
    """
    joint = _Joint.of(posed, groups, kept)
    transients = hide_transients(posed.views, groups, [scene.transients for scene in joint.scenes])
    scenes, seams = joint.scenes, find_seams(groups)
    files = photo_files(posed.views.names, posed.photo_cameras, sources)
    photos = LargePhotos(posed.views, posed.cameras, files, joint.exposures)
    entries, warnings = _compared(seams, joint, posed, kept)
    size = max(scene.size for scene in scenes)
    parts = divide(posed, min(len(groups), parts_needed(photos, size)))
    gaussians, smoothing = _optimised(parts, photos, size, joint.gaussians, settings.seed, progress)
    runs = [*(entry for scene in scenes for entry in scene.entries["tto"]), *smoothing]
    scene = _scene(posed, joint, depth_maps_of_all(groups, [each.entries["depth_maps"] for each in scenes]))
    further = FullSize(gaussians, size, runs, _summary(scenes, len(gaussians)), False, joint.exposures)
    scene = replace(scene, files=files, full_size=further, transients=transients)
    if settings.backdrop and scene.prepared.anchors is not None and shows_background(posed.views):
        scene = replace(scene, backdrop=photos.backdrop(gaussians))
    peak = max(each.entries.pop("process_peak_gib") for each in scenes)
    regions = [
        {
            "photos": len(group.core),
            "overlap": len(group.overlap),
            "gaussians": own,
            **{name: value for name, value in each.entries.items() if name not in IN_THE_WHOLE},
        }
        for group, own, each in zip(groups, joint.own, scenes, strict=True)
    ]
    names = [tuple(posed.views.names[row] for row in group.core) for group in groups]
    return BuiltRegions(scene, regions, names, entries, warnings, peak)


def hide_transients(
    views: Views, groups: Sequence[Group], transients: Sequence[Mapping[int, Bool[torch.Tensor, "_ _"]]]
) -> MaskedShare | None:
    """Hide in `views` the transients of all regions, by the row of a group's photo. Returns how much they are."""
    found: dict[int, int] = {}
    for group, gone in zip(groups, transients, strict=True):
        for row, pixels in gone.items():
            photo = group.rows[row]
            found[photo] = found.get(photo, 0) + int((views.masks[photo] & pixels).sum())
            views.hide(photo, pixels)
    return MaskedShare.of(found, views.sizes)


def depth_maps_of_all(groups: Sequence[Group], maps: Sequence[UsedDepthMaps | None]) -> UsedDepthMaps | None:
    """What became of the depth maps of all regions; None where no photo came with one.

    A photo in several regions counts as in its own. There is one unit where the regions' units hardly differ.
    """
    found = [(group.core, each) for group, each in zip(groups, maps, strict=True) if each]
    if not found:
        return None
    given = tuple(core[row] for core, each in found for row in each.given if row < len(core))
    used = tuple(core[row] for core, each in found for row in each.used if row < len(core))
    differences = [each.difference for _, each in found if each.difference is not None]
    units = [each.per_unit or math.nan for _, each in found if each.used]
    limit = 1 + PIPELINE_POLICY.common_depth_unit
    common = bool(units) and all(one <= limit * other for one in units for other in units)
    return UsedDepthMaps(given, used, median(differences) if differences else None, median(units) if common else None)


@dataclass(frozen=True)
class _Joint:
    """Regions in common colours: what they have beside Gaussians, how many of these stay, and those as one scene.

    transforms: from the colours of each region to the common ones; none where these are the same.
    """

    scenes: list[RegionScene]
    own: list[int]
    gaussians: Gaussians
    exposures: Exposures | None
    transforms: list[torch.Tensor]

    @classmethod
    def of(cls, posed: PosedViews, groups: Sequence[Group], kept: KeptRegions) -> "_Joint":
        scenes = [kept.without_gaussians(number) for number in range(len(groups))]
        exposures, transforms = common_exposures(groups, scenes, len(posed.views))
        empty = cls(scenes, [], scenes[0].gaussians, exposures, transforms if exposures else [])
        small = [small_cameras(posed.cameras[list(group.core)]) for group in groups]
        views = CoreViews.of([(cameras, each.depth) for cameras, each in zip(small, scenes, strict=True)])
        own = []
        for number in range(len(groups)):
            whole = empty.whole(number, kept)
            own.append(whole[owners(whole.means, views) == number])
        return replace(empty, own=[len(each) for each in own], gaussians=joined(*own))

    def whole(self, number: int, kept: KeptRegions) -> Gaussians:
        """All Gaussians of a region."""
        gaussians = kept[number].gaussians
        return recoloured(gaussians, self.transforms[number]) if self.transforms else gaussians


def _compared(
    seams: Sequence[Seam], joint: _Joint, posed: PosedViews, kept: KeptRegions
) -> tuple[list[dict[str, Any]], tuple[str, ...]]:
    """The entry of every seam, and a warning for each bad one. Raises ImpossibleScene where one is too bad to join."""
    entries: list[dict[str, Any]] = []
    warnings: list[str] = []
    for seam in seams:
        one, other = seam.regions
        decibels = disagreement(
            seam, posed.cameras, posed.views.sizes, (joint.whole(one, kept), joint.whole(other, kept))
        )
        entries.append({"regions": [one + 1, other + 1], "photos": len(seam.photos), "psnr": round(decibels, 2)})
        warning = verdict(seam, decibels)
        warnings += [warning] if warning else []
    return entries, tuple(warnings)


def _optimised(
    parts: Sequence[Group],
    photos: LargePhotos,
    size: int,
    gaussians: Gaussians,
    seed: int,
    progress: Progress,
) -> tuple[Gaussians, list[dict[str, Any]]]:
    """The joint scene after the last optimisation on the photos of every part, and its entries in the report.

    Raises KeyboardInterrupt where Ctrl-C ended a part.
    """
    runs = []
    for number, group in enumerate(parts):
        shown = partial(_part, progress, number / len(parts), 1 / len(parts))
        gaussians, run, result = smoothed(list(group.rows), photos, size, gaussians, seed=seed, progress=shown)
        if result.interrupted:
            raise KeyboardInterrupt  # the regions stay, and the same command goes on with them
        (entry,) = tto_entries([(run, result)])
        runs.append({**entry, "max_size": size})
    return gaussians, runs


def _summary(scenes: Sequence[RegionScene], gaussians: int) -> dict[str, Any]:
    """What the report says of the optimisation on large photos, all regions together; nothing where there was none."""
    found = [each.entries["full_size"] for each in scenes if each.entries["full_size"]]
    sums = {name: sum(each[name] for each in found) for name in ("planned_seconds", "hiding")}
    not_kept = [size for each in found for size in each.get("not_kept", ())]
    return {**found[0], **sums, "gaussians": gaussians, "not_kept": not_kept} if found else {}


def _scene(posed: PosedViews, joint: _Joint, maps: UsedDepthMaps | None) -> BuiltScene:
    """Nothing decodes to the Gaussians of a joint scene, so it has queries and memories without a row."""
    scenes = joint.scenes
    prepared = scenes[0].prepared
    memories = cast(Memories, prepared.variables)
    adapted = Adapted(memories, joint.gaussians, posed.cameras, (), exposures=joint.exposures)
    warnings = tuple(dict.fromkeys(line for each in scenes for line in each.entries["warnings"]))
    measured = [each.disagreement for each in scenes if each.disagreement is not None]
    same = joint.exposures or Exposures.identity(len(posed.views))
    colours = PhotoColours(same, max(measured)) if measured else None
    return BuiltScene(posed, Geometry(None, None, (), 1, warnings, maps), prepared, adapted, colours=colours)


def _part(progress: Any, start: float, share: float, text: str, fraction: float) -> None:
    progress(text, start + share * fraction)
