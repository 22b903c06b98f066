"""Photos with cameras become one scene, region by region."""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from querysplat_cli.encoders.base import Encoder, PosedViews
from querysplat_cli.pipeline.distinct import distinct_views
from querysplat_cli.pipeline.kept_parts import read_part, write_part
from querysplat_cli.pipeline.policy import PIPELINE_POLICY
from querysplat_cli.pipeline.regions.groups import divide
from querysplat_cli.pipeline.regions.join import BuiltRegions, join
from querysplat_cli.pipeline.regions.scene import KeptRegions, RegionScene
from querysplat_cli.pipeline.regions.task import SCENE, TASK, region_maker, region_task
from querysplat_cli.pipeline.settings import ReconstructSettings
from querysplat_cli.pipeline.unfinished import Unfinished
from querysplat_cli.runtime import signals
from querysplat_cli.runtime.cluster import check_cluster
from querysplat_cli.runtime.engine import Engine
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.lengths import BY_DEPTH
from querysplat_cli.runtime.progress import StageProgress, Stages
from querysplat_cli.scene.views import PhotoSource


def region_count(settings: ReconstructSettings, photos: int, encoder: Encoder) -> int:
    """How many regions so many photos become.

    Raises QuerySplatError where --regions cannot be had: too few photos, an encoder whose depth needs all photos at
    once, or another option that is for one region alone.
    """
    wanted, asked = settings.regions, f"--regions {settings.regions}"
    for_one = settings.budget is not None or bool(settings.refine_cameras) or settings.metres_by == BY_DEPTH
    alone = encoder.own_frame or for_one
    if wanted is None:
        alone = alone or photos <= PIPELINE_POLICY.undivided_photos
        return 1 if alone else -(-photos // PIPELINE_POLICY.region_photos)
    if wanted == 1:
        return 1
    if encoder.own_frame:
        raise QuerySplatError(
            f"{asked}: the encoder {encoder.name} takes all photos at once", "Use --encoder classical."
        )
    if alone:
        others = "--budget, --refine-cameras and --scale depth"
        raise QuerySplatError(f"{asked}: {others} are for one region", "Leave one of them out.")
    most = photos // PIPELINE_POLICY.fewest_region_photos
    if wanted > most:
        raise QuerySplatError(
            f"{asked}: {photos} photos with cameras are too few", f"Use at most {max(1, most)}, or leave it out."
        )
    return wanted


def check_regions(settings: ReconstructSettings, photos: int, encoder: Encoder) -> None:
    """Raise as `region_count` and `check_cluster` do, before cameras are found: of so many photos or fewer."""
    if region_count(settings, photos, encoder) > 1 and settings.cluster:
        check_cluster(settings.cluster)


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
        posed, duplicates = distinct_views(posed, keep_all=settings.keep_everything)
        if duplicates:
            posed = replace(posed, views=work.filed("distinct", posed.views))
        groups = divide(posed, count)
        folders = [work.region(number) for number in range(1, count + 1)]
        for folder, group in zip(folders, groups, strict=True):
            # Anew each time: photos may have moved since an earlier run, and its task may be cut off.
            write_part(folder / TASK, region_task(posed, group, settings, sources))
    try:
        _carry_out(folders, engine, stages)
    except KeyboardInterrupt:
        done = sum((folder / SCENE).is_file() for folder in folders)
        raise QuerySplatError(
            f"stopped: {done} of {count} regions are done", "The same command goes on from there.",
            signals.exit_code(),
        ) from None  # fmt: skip
    kept = KeptRegions(lambda number: _read(folders[number] / SCENE))
    with stages("join") as progress:
        joined = join(posed, groups, kept, settings, sources, progress)
    return replace(joined, scene=replace(joined.scene, duplicates=duplicates))


def _carry_out(folders: Sequence[Path], engine: Engine, stages: Stages) -> None:
    """Let `engine` make all regions; each is a stage of the name of its folder."""
    with ExitStack() as stack:
        shown: dict[Path, tuple[ExitStack, StageProgress]] = {}
        over: set[Path] = set()

        def heard(folder: Path, text: str, fraction: float) -> None:
            if folder not in shown:
                stage = stack.enter_context(ExitStack())
                shown[folder] = stage, stage.enter_context(stages(folder.name))
            elif folder not in over:
                shown[folder][1](text, fraction)

        def done(folder: Path, why: str | None) -> None:
            over.add(folder)
            if folder in shown:
                shown[folder][0].close()
            if why:
                raise QuerySplatError(f"{folder.name}: {why}", "The same command goes on with what is missing.")

        engine.run(region_maker, None, folders, done, heard)


def _read(path: Path) -> RegionScene:
    scene: RegionScene | None = read_part(path)
    if scene is None:
        raise QuerySplatError(f"{path} is missing or damaged", "The same command makes it again.")
    return scene
