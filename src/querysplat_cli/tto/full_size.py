"""Test-time optimisation in Gaussian space on large photos, coarse to fine in pixels and in Gaussians."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool
from torch import Tensor

from querysplat_cli.prune.far import drawn_in
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.exposures import Exposures
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.views import Views
from querysplat_cli.splat.smoothing import bounded
from querysplat_cli.tto.exposure_refit import RefittedExposures
from querysplat_cli.tto.full_size_plan import FullSizePlan, FullSizeStage
from querysplat_cli.tto.full_size_policy import FULL_SIZE_POLICY
from querysplat_cli.tto.gaussians import Changes, optimise_gaussians
from querysplat_cli.tto.optimise import TtoResult
from querysplat_cli.tto.options import Callbacks, Look, TtoStep
from querysplat_cli.tto.rendering_loss import RenderingLoss


@dataclass(frozen=True)
class PhotoFacts:
    """What is known of the photos beside their pictures and cameras.

    exposures: the colour transforms to start with (None: photos show the scene's own colours).
    confirmed: where other views agree with the depth of each working picture (None: that is not known).
    """

    exposures: Exposures | None = None
    confirmed: tuple[Bool[Tensor, "_ _"], ...] | None = None


INTERRUPTED = "Ctrl-C"
"""Why a scene was optimised no further, where a user ended that."""


@dataclass(frozen=True)
class FullSizeResult:
    """A scene after its stages and rounds, with their results, and why no more followed (a phrase).

    `exposures` are the colour transforms of its photos, where it has them. `not_kept` are the picture sizes of planned
    stages that made the photos look worse, and whose Gaussians were dropped. One that took no step is not among them.
    """

    gaussians: Gaussians
    runs: tuple[tuple[FullSizeStage, TtoResult[Changes]], ...]
    ended: str
    exposures: Exposures | None = None
    not_kept: tuple[int, ...] = ()

    @property
    def interrupted(self) -> bool:
        return self.ended == INTERRUPTED


def optimise_full_size(
    gaussians: Gaussians,
    views_at: Callable[[int], tuple[Views, Cameras]],
    plan: FullSizePlan,
    *,
    seed: int,
    facts: PhotoFacts = PhotoFacts(),
    progress: Callable[[FullSizeStage, TtoStep], None] = lambda stage, step: None,
    look: Look = lambda gaussians: None,
) -> FullSizeResult:
    """Carry out `plan`. Each step renders one view over a background of random colour.

    `views_at(max_size)` gives the input views at a longer side of at most so many pixels. Only those of one size are
    held at a time. No Gaussian of the result is thinner than a pixel of the last pictures (`splat/smoothing.py`).
    Raises KeyboardInterrupt where Ctrl-C comes while the first pictures are read; later, it ends with what was reached.
    """
    generator = torch.Generator().manual_seed(seed)
    refitted = RefittedExposures(facts.exposures) if facts.exposures else None
    runs: list[tuple[FullSizeStage, TtoResult[Changes]]] = []
    target: RenderingLoss | None = None
    size = 0
    bounds: Cameras | None = None

    def run(stage: FullSizeStage) -> TtoResult[Changes]:
        """Raises KeyboardInterrupt where Ctrl-C came, after what the stage reached by then was taken in."""
        nonlocal target, size, bounds
        if target is None or size != stage.max_size:
            target = None  # the smaller pictures make room for the larger ones
            views, cameras = views_at(stage.max_size)
            target = full_size_loss(views, cameras, facts.confirmed, generator, refitted)
            size = stage.max_size
        target = replace(target, halved=stage.halved)
        start = runs[-1][1].gaussians if runs else gaussians
        result = optimise_gaussians(
            start,
            target,
            stage.settings,
            generator=generator,
            callbacks=Callbacks(lambda step: progress(stage, step), look=look),
            densify_to=stage.gaussians if stage.gaussians > len(start) else None,
        )
        # Changes belong to Gaussians that are gone; only the numbers of the run are used.
        runs.append((stage, replace(result, variables=result.variables.map(lambda part: part[:0]))))
        bounds = target.cameras
        if result.interrupted:
            raise KeyboardInterrupt
        return result

    try:
        ended = _carried_out(plan, run)
    except KeyboardInterrupt:
        if not runs:
            raise
        ended = INTERRUPTED
    assert bounds
    sharp = bounded(drawn_in(runs[-1][1].gaussians, bounds), bounds)
    stages = [(stage, result) for stage, result in runs[: len(plan.stages)] if result.history]
    not_kept = tuple(stage.max_size for stage, result in stages if not result.loss_after < result.loss_before)
    return FullSizeResult(sharp, tuple(runs), ended, refitted.current if refitted else None, not_kept)


def full_size_loss(
    views: Views,
    cameras: Cameras,
    confirmed: tuple[Bool[Tensor, "_ _"], ...] | None,
    generator: torch.Generator,
    exposures: RefittedExposures | None = None,
) -> RenderingLoss:
    """The loss of photos at a large size. `confirmed` is that of `PhotoFacts`."""
    solid = RenderingLoss.for_solid_scenes(views, cameras, generator, exposures)
    return replace(solid, confirmed=confirmed, ssim_weight=FULL_SIZE_POLICY.ssim_weight)


def _carried_out(plan: FullSizePlan, run: Callable[[FullSizeStage], TtoResult[Changes]]) -> str:
    """All stages, and rounds until the loss on the input photos stops falling; returns why they ended."""
    results = [run(stage) for stage in plan.stages]
    for stage, result in zip(plan.stages, results, strict=True):
        if len(result.history) + result.undone < stage.settings.steps:
            timed = stage.settings.seconds is not None
            return "the time was over" if timed else "steps were undone again and again"
    if not plan.round:
        return "every planned step was taken"
    for _ in range(plan.most_rounds):
        result = run(plan.round)
        if result.loss_after > (1 - FULL_SIZE_POLICY.least_gain) * result.loss_before:
            return "the loss on the input photos stopped falling"
    return f"{plan.most_rounds} rounds were taken"
