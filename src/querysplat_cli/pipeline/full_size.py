"""A scene that was made of small pictures is optimised further on its photos at a large size."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch

from querysplat_cli.pipeline.scene_folder import StoredScene
from querysplat_cli.queries.backdrop import with_backdrop
from querysplat_cli.reporting.report import quality_entry, tto_entries
from querysplat_cli.reporting.view_scores import score
from querysplat_cli.runtime.choices import FullSizeLevel
from querysplat_cli.runtime.device import to_device
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.progress import Stages
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.photo_files import PhotoFile, check_photo_files, large_views
from querysplat_cli.scene.views import Views
from querysplat_cli.splat.conventions import MID_GREY
from querysplat_cli.tto.full_size import FullSizeResult, optimise_full_size
from querysplat_cli.tto.full_size_plan import FullSizePlan, FullSizeStage, Photos, plan_full_size
from querysplat_cli.tto.options import TtoStep
from querysplat_cli.tto.plan import TtoRun


@dataclass(frozen=True)
class FullSize:
    """A scene after its optimisation on large photos, and its entries in the report.

    backdrop: how many of the Gaussians, the last ones, are the backdrop.
    quality: PSNR and SSIM at the large size, of the inputs and of the held-out views.
    runs: one entry for each stage and round, as for other runs.
    summary: the level, the plan, and why the optimisation ended.
    """

    gaussians: Gaussians
    backdrop: int
    quality: dict[str, Any]
    runs: list[dict[str, Any]]
    summary: dict[str, Any]


def take_to_full_size(
    scene: StoredScene,
    gaussians: Gaussians,
    level: FullSizeLevel,
    *,
    seed: int,
    device: torch.device,
    stages: Stages,
    seconds: float | None = None,
) -> FullSize:
    """Optimise `gaussians` on the photos of `scene`, and score the result at the large size.

    The backdrop of a scene that has one is left out meanwhile, and made anew. With `seconds` the clock ends the steps,
    and decides how large the photos are. Raises QuerySplatError when photos are gone.
    """
    files = files_of(scene, scene.views)
    held = files_of(scene, scene.heldout[0]) if scene.heldout else []
    check_photo_files([*files, *held])
    gaussians = gaussians[: len(gaussians) - scene.backdrop]
    with stages("full size") as progress:
        height, width = max((file.full_size() for file in files), key=lambda size: size[0] * size[1])
        working = max(scene.cameras.height, scene.cameras.width)
        plan = plan_full_size(level, Photos(len(files), height, width, working), len(gaussians), seconds=seconds)
        total = sum(stage.settings.steps for stage in plan.stages)
        taken = 0

        def show(stage: FullSizeStage, step: TtoStep) -> None:
            nonlocal taken
            taken += 1
            text = f"{stage.max_size} px: loss {step.loss:.4f}, {step.psnr:.2f} dB, {step.gaussians:,} Gaussians"
            progress(text, min(1.0, taken / total))

        def views_at(size: int) -> tuple[Views, Cameras]:
            return to_device(large_views(files, scene.views, scene.cameras, size), device)

        result = optimise_full_size(to_device(gaussians, device), views_at, plan, seed=seed, progress=show)
    better = to_device(result.gaussians, torch.device("cpu"))
    behind = 0
    if scene.backdrop:
        better, behind = with_backdrop(better, scene.views, scene.cameras)
    size = result.runs[-1][0].max_size
    with stages("full size score"):
        quality: dict[str, Any] = {"max_size": size, "background": MID_GREY, "input": None, "heldout": None}
        groups = {"input": (files, scene.views, scene.cameras)}
        if scene.heldout:
            groups["heldout"] = (held, *scene.heldout)
        for name, group in groups.items():
            quality[name] = _scored(better, *group, size)
    return FullSize(better, behind, quality, _entries(result), _summary(level, plan, result, len(better)))


def files_of(scene: StoredScene, views: Views) -> list[PhotoFile]:
    """The photo files of `views`. Raises QuerySplatError when the scene has no list of them."""
    missing = [name for name in views.names if name not in scene.photos]
    if missing:
        raise QuerySplatError(
            f"the scene does not say where its photo {missing[0]} lies",
            "Make the scene again. Only the encoder `classical` uses photos that can be found again.",
        )
    return [scene.photos[name] for name in views.names]


def _scored(
    gaussians: Gaussians, files: Sequence[PhotoFile], views: Views, cameras: Cameras, size: int
) -> dict[str, Any]:
    return quality_entry(score(gaussians, *large_views(files, views, cameras, size), MID_GREY))


def _entries(result: FullSizeResult) -> list[dict[str, Any]]:
    runs = [(TtoRun("gaussians", stage.settings), run) for stage, run in result.runs]
    sizes = [stage.max_size for stage, _ in result.runs]
    return [{**entry, "max_size": size} for entry, size in zip(tto_entries(runs), sizes, strict=True)]


def _summary(level: FullSizeLevel, plan: FullSizePlan, result: FullSizeResult, count: int) -> dict[str, Any]:
    return {
        "level": level,
        "ended": result.ended,
        "gaussians": count,
        "planned_seconds": round(plan.seconds, 1),
        "stages": [asdict(stage) for stage in plan.stages],
        "most_rounds": plan.most_rounds,
    }
