"""A scene that was made of small pictures is optimised further in Gaussian space, on its photos at a larger size."""

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor

from querysplat_cli.pipeline.scene_folder import StoredScene
from querysplat_cli.prune.hiding import hiding
from querysplat_cli.queries.backdrop import backdrop
from querysplat_cli.queries.prepare import NOT_KNOWN
from querysplat_cli.reporting.report import quality_entry, tto_entries
from querysplat_cli.reporting.view_scores import Quality, score
from querysplat_cli.runtime.device import to_device
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.progress import StageProgress
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.exposures import Exposures
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.photo_files import PhotoFile, check_photo_files, large_views
from querysplat_cli.scene.views import Views
from querysplat_cli.splat.conventions import MID_GREY
from querysplat_cli.tto.full_size import FullSizeResult, PhotoFacts, optimise_full_size
from querysplat_cli.tto.full_size_plan import FullSizePlan, FullSizeStage, Photos, step_seconds
from querysplat_cli.tto.options import TtoStep
from querysplat_cli.tto.plan import TtoRun
from querysplat_cli.tto.rendering_loss import RenderingLoss

PACE_STEPS = 4
"""Steps that are timed where a clock ends the optimisation."""
AT_ONCE = 32
"""Large photos that are in memory at a time where they are scored."""


@dataclass(frozen=True)
class LargePhotos:
    """Views of a scene at the sizes that their photos have.

    `files` are the photos of `views`; without them, the pictures are as large as `views`. `exposures` are the colour
    transforms of the photos, where the scene has any. `confirmed` marks the pixels of `views` whose depth was measured
    (empty: that is not known).
    """

    views: Views
    cameras: Cameras
    files: Sequence[PhotoFile] = ()
    exposures: Exposures | None = None
    confirmed: Bool[Tensor, "confirmed height width"] = NOT_KNOWN

    @property
    def working(self) -> int:
        """The longer side of the working pictures, in pixels."""
        return max(max(size) for size in self.views.sizes)

    def summary(self) -> Photos:
        """What the plan counts. Raises QuerySplatError when photos are gone."""
        check_photo_files(self.files)
        sizes = [file.full_size() for file in self.files] or self.views.sizes
        height, width = max(sizes, key=lambda size: size[0] * size[1])
        return Photos(len(self.views), height, width, self.working)

    def at(self, size: int) -> tuple[Views, Cameras]:
        """Pictures of at most `size` pixels, and their cameras."""
        if size <= self.working or not self.files:
            return self.views, self.cameras
        return large_views(self.files, self.views, self.cameras, size)

    def confirmed_pictures(self) -> tuple[Bool[Tensor, "_ _"], ...] | None:
        """`confirmed` of each picture, without the padding of the canvas."""
        if not len(self.confirmed):
            return None
        each = zip(self.confirmed, self.views.sizes, strict=True)
        return tuple(shown[:height, :width] for shown, (height, width) in each)

    def backdrop(self, gaussians: Gaussians) -> Gaussians:
        """What stands behind `gaussians` (`queries/backdrop.py`), in the scene's own colours."""
        return backdrop(gaussians, self.views, self.cameras, self.exposures)

    def some(self, rows: Sequence[int]) -> "LargePhotos":
        """Those of these rows."""
        return LargePhotos(
            self.views[rows], self.cameras[rows], [self.files[row] for row in rows] if self.files else (),
            self.exposures and self.exposures[rows], self.confirmed[rows] if len(self.confirmed) else self.confirmed,
        )  # fmt: skip


@dataclass(frozen=True)
class FullSize:
    """A scene after its optimisation on large photos, and its entries in the report.

    size: the longer side of the largest pictures, in pixels.
    runs: one entry for each stage and round, as for other runs.
    summary: the level, the plan, why the optimisation ended, how many Gaussians were left out because they hid what
        photos show, and the sizes of stages that were not kept.
    exposures: the colour transforms of the input photos, where the scene had any.
    """

    gaussians: Gaussians
    size: int
    runs: list[dict[str, Any]]
    summary: dict[str, Any]
    interrupted: bool
    exposures: Exposures | None = None


def take_to_full_size(
    photos: LargePhotos,
    gaussians: Gaussians,
    plan: FullSizePlan,
    *,
    seed: int,
    device: torch.device,
    progress: StageProgress,
) -> FullSize:
    """Optimise `gaussians`, without those that hide what `photos` show (`prune/hiding.py`).

    Raises QuerySplatError when photos are gone or have changed, and KeyboardInterrupt where Ctrl-C comes before the
    first stage.
    """
    total = sum(stage.settings.steps for stage in plan.stages)
    taken = 0

    def show(stage: FullSizeStage, step: TtoStep) -> None:
        nonlocal taken
        taken += 1
        text = f"{stage.max_size} px: loss {step.loss:.4f}, {step.psnr:.2f} dB, {step.gaussians:,} Gaussians"
        progress(text, min(1.0, taken / total))

    def views_at(size: int) -> tuple[Views, Cameras]:
        return to_device(photos.at(size), device)

    start = to_device(gaussians, device)
    hidden = hiding(start, to_device(photos.cameras, device), photos.views.sizes)
    look = partial(progress.look, views=photos.views, cameras=photos.cameras)
    facts = PhotoFacts(photos.exposures, to_device(photos.confirmed_pictures(), device))
    result = optimise_full_size(start[~hidden], views_at, plan, seed=seed, facts=facts, progress=show, look=look)
    return FullSize(
        to_device(result.gaussians, torch.device("cpu")),
        result.runs[-1][0].max_size,
        _entries(result),
        _summary(plan, result, int(hidden.sum())),
        result.interrupted,
        result.exposures,
    )


def machine_pace(photos: LargePhotos, gaussians: Gaussians, device: torch.device) -> float:
    """How many times as long as the plan counts a step takes here, now: the least of a few on one working picture.

    It is for plans that a clock ends.
    """
    row = [len(photos.views) // 2]
    views, cameras, some = to_device((photos.views[row], photos.cameras[row], gaussians), device)
    target = RenderingLoss.for_solid_scenes(views, cameras, torch.Generator())
    taken = []
    for _ in range(PACE_STEPS):
        began = time.perf_counter()
        target.value_and_gradient(some, [0])
        taken.append(time.perf_counter() - began)
    return min(taken) / step_seconds(cameras.height * cameras.width, len(some))


def full_size_quality(
    gaussians: Gaussians, size: int, inputs: LargePhotos, heldout: LargePhotos | None
) -> dict[str, Any]:
    """The entry `quality.full_size` of the report: PSNR and SSIM over grey, at a longer side of `size` pixels."""
    quality: dict[str, Any] = {"max_size": size, "background": MID_GREY}
    for name, photos in {"input": inputs, "heldout": heldout}.items():
        quality[name] = photos and quality_entry(_scored(gaussians, size, photos))
    return quality


def _scored(gaussians: Gaussians, size: int, photos: LargePhotos) -> Quality:
    """Some photos at a time, because large ones take much memory."""
    rows = list(range(len(photos.views)))
    parts = [rows[start : start + AT_ONCE] for start in range(0, len(rows), AT_ONCE)]
    return Quality.together([score(gaussians, *photos.some(part).at(size), MID_GREY) for part in parts])


def stored_photos(scene: StoredScene) -> tuple[LargePhotos, LargePhotos | None]:
    """Input and held-out photos of a stored scene. Raises QuerySplatError when photos are gone."""
    confirmed = NOT_KNOWN if scene.map is None else scene.map.confirmed
    inputs = LargePhotos(scene.views, scene.cameras, files_of(scene, scene.views), scene.exposures, confirmed)
    heldout = scene.heldout and LargePhotos(*scene.heldout, files_of(scene, scene.heldout[0]))
    check_photo_files([*inputs.files, *(heldout.files if heldout else ())])
    return inputs, heldout


def files_of(scene: StoredScene, views: Views) -> list[PhotoFile]:
    """The photo files of `views`. Raises QuerySplatError when the scene has no list of them."""
    missing = [name for name in views.names if name not in scene.photos]
    if missing:
        raise QuerySplatError(
            f"the scene does not say where its photo {missing[0]} lies",
            "Make the scene again. Only the encoder `classical` uses photos that can be found again.",
        )
    return [scene.photos[name] for name in views.names]


def _entries(result: FullSizeResult) -> list[dict[str, Any]]:
    runs = [(TtoRun("gaussians", stage.settings), run) for stage, run in result.runs]
    sizes = [stage.max_size for stage, _ in result.runs]
    return [{**entry, "max_size": size} for entry, size in zip(tto_entries(runs), sizes, strict=True)]


def _summary(plan: FullSizePlan, result: FullSizeResult, left_out: int) -> dict[str, Any]:
    return {
        "level": plan.level,
        "ended": result.ended,
        "gaussians": len(result.gaussians),
        "planned_seconds": round(plan.seconds, 1),
        "stages": [asdict(stage) for stage in plan.stages],
        "most_rounds": plan.most_rounds,
        "hiding": left_out,
        "not_kept": list(result.not_kept),
    }
