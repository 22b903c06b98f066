"""One region is reconstructed: a folder with a task in, a scene in the same folder out."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch

from querysplat_cli.encoders.base import CameraRequest, Encoder, Geometry, PosedViews
from querysplat_cli.encoders.holdout import select_views
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.pipeline.build import Allowance, BuiltScene, encode_and_build_all
from querysplat_cli.pipeline.kept_parts import read_part, write_part
from querysplat_cli.pipeline.omitted import omissions_of
from querysplat_cli.pipeline.parts import load_parts
from querysplat_cli.pipeline.regions.groups import Group
from querysplat_cli.pipeline.regions.owners import depth_maps
from querysplat_cli.pipeline.regions.scene import RegionScene, RegionTask
from querysplat_cli.pipeline.settings import ReconstructSettings
from querysplat_cli.queries.prepare import without_rows
from querysplat_cli.reporting.report import seconds_entry, tto_entries
from querysplat_cli.reporting.view_scores import score
from querysplat_cli.runtime.compiler import SCENE_KERNELS, start_compiling
from querysplat_cli.runtime.device import find_device, peak_gib, reset_peak_memory
from querysplat_cli.runtime.engine import report_progress
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.precision import check_precision, matrix_products
from querysplat_cli.runtime.progress import Progress, Stages
from querysplat_cli.scene.views import Photo, PhotoSource

TASK, DEPTH, SCENE = "task.pt", "depth.pt", "scene.pt"
SHARES = {"depth": 0.25, "queries": 0.05, "tto": 0.3, "full size": 0.4}
"""About how the time of a region is shared among its stages, for one bar of progress."""


def region_task(
    posed: PosedViews, group: Group, settings: ReconstructSettings, sources: Mapping[str, PhotoSource]
) -> RegionTask:
    """The task of one group of `posed`, with the sparse points that its photos see.

    A number of Gaussians to keep is shared out by the photos of the cores. The paths of photos are absolute, as those
    of the settings are: a worker has another current folder.
    """
    chosen = select_views(posed, list(group.rows))
    if chosen.visibility:
        seen, rows = torch.cat(chosen.visibility).unique(return_inverse=True)
        visibility = rows.split([len(each) for each in chosen.visibility])
        chosen = replace(chosen, points=chosen.points[seen], visibility=visibility, left_out=(), warnings=())
    alone = replace(settings, backdrop=False, refine_cameras=False)
    if isinstance(settings.prune, int):
        alone = replace(alone, prune=max(1, settings.prune * len(group.core) // len(posed.views)))
    files = {name: replace(sources[name], path=sources[name].path.absolute()) for name in chosen.views.names}
    return RegionTask(chosen, len(group.core), files, alone)


def region_maker(setup: Any) -> Callable[[Path], None]:
    """What an engine calls in each process."""
    return run_region


def run_region(folder: Path) -> None:
    """Make the scene of the task in `folder`, unless it is there. The same task gives the same scene.

    The depth is kept until then, so that a later run of a killed one need not find it again. Raises QuerySplatError
    where the folder has no task, and KeyboardInterrupt where Ctrl-C ended an optimisation.
    """
    if read_part(folder / SCENE) is not None:
        return
    report_progress("", 0.0)
    task: RegionTask | None = read_part(folder / TASK)
    if task is None:
        raise QuerySplatError(f"{folder} has no task of a region", "Run the whole command again.")
    device = find_device(task.settings.device)
    if device.type == "cpu":
        start_compiling(*SCENE_KERNELS)
    before = peak_gib()
    restarted = reset_peak_memory()
    stages = Stages(_summed(report_progress))
    with matrix_products(check_precision(task.settings.precision)):
        model, encoder = _parts(replace(task.settings, prune="auto"))  # `prune` differs from region to region
        kept = KeptDepth(encoder, folder / DEPTH)
        # Near-duplicates were left out before the photos were divided; the scene has a row for each photo of the task.
        scene = encode_and_build_all(task.posed, kept, model, task.settings, stages, Allowance(None, task.sources))
        if scene.interrupted:
            raise KeyboardInterrupt
        found = _scene(task, scene, stages)
    found.entries["peak_memory_gib"] = round(peak_gib(), 2)
    found.entries["process_peak_gib"] = round(max(before, peak_gib()) if restarted else peak_gib(), 2)
    write_part(folder / SCENE, found)
    (folder / DEPTH).unlink(missing_ok=True)


def _scene(task: RegionTask, scene: BuiltScene, stages: Stages) -> RegionScene:
    further, core = scene.full_size, list(range(task.core))
    hidden = task.posed.views.masks & ~scene.posed.views.masks
    views, cameras = scene.posed.views[core], scene.adapted.cameras[core]
    quality = score(scene.gaussians, views, cameras)
    entries = {
        "quality": quality.summary(),
        "seconds": seconds_entry(stages.seconds),
        "tto": [*tto_entries(scene.adapted.runs), *(further.runs if further else [])],
        "full_size": further.summary if further else None,
        "left_out": [asdict(omission) for omission in omissions_of(task.settings, scene)],
        "warnings": list(scene.geometry.warnings),
        "depth_maps": scene.geometry.depth_maps,
    }
    return RegionScene(
        gaussians=scene.gaussians.detach(),
        transients={row: gone for row, gone in enumerate(hidden) if gone.any()},
        depth=depth_maps(scene.gaussians, cameras, views.sizes),
        prepared=without_rows(scene.prepared, scene.adapted.memories),
        exposures=scene.exposures,
        disagreement=scene.colours.disagreement if scene.colours else None,
        size=further.size if further else scene.inputs.working,
        entries=entries,
    )


class KeptDepth:
    """An encoder that keeps its geometry of one set of views in a file."""

    def __init__(self, encoder: Encoder, file: Path) -> None:
        self.name, self.size, self.own_frame = encoder.name, encoder.size, encoder.own_frame
        self._encoder, self._file = encoder, file

    def estimate_cameras(self, photos: Sequence[Photo], request: CameraRequest, progress: Progress) -> PosedViews:
        return self._encoder.estimate_cameras(photos, request, progress)

    def estimate_geometry(self, posed: PosedViews, *, seed: int, progress: Progress) -> Geometry:
        """That of the file, or a new one, which is written there."""
        found: Geometry | None = read_part(self._file)
        if found is None:
            found = self._encoder.estimate_geometry(posed, seed=seed, progress=progress)
            write_part(self._file, found)
        return found

    def free(self) -> None:
        """Nothing is freed: the next region needs the encoder again."""

    def bytes_needed(self, views: int, size: int) -> int | None:
        return self._encoder.bytes_needed(views, size)


@lru_cache(maxsize=1)
def _parts(settings: ReconstructSettings) -> tuple[QuerySplat, Encoder]:
    """Those of the last call stay in memory: the regions of a scene have the same settings."""
    return load_parts(settings, find_device(settings.device))


def _summed(progress: Progress) -> Callable[[str, str, float], None]:
    """The progress of all stages of a region as one."""
    done: dict[str, float] = {}

    def listen(stage: str, text: str, fraction: float) -> None:
        done[stage] = fraction
        progress(f"{stage} {text}".strip(), sum(SHARES.get(name, 0.0) * share for name, share in done.items()))

    return listen
