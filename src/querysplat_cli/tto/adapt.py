"""Test-time optimisation of a scene: in feature space, in Gaussian space, or in one after the other."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool
from torch import Tensor

from querysplat_cli.model.memories import Features, Memories
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.prune.bands import IdleBands
from querysplat_cli.prune.gaussians import Pruned
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.exposures import Exposures
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.tto.features import Start, gaussians_of, memories_of, optimise_memories
from querysplat_cli.tto.gaussians import optimise_gaussians
from querysplat_cli.tto.optimise import TtoResult
from querysplat_cli.tto.options import Callbacks, Look, OptimiseOptions, TtoStep
from querysplat_cli.tto.plan import TtoRun
from querysplat_cli.tto.pruning import pruning_to
from querysplat_cli.tto.rendering_loss import RenderingLoss


@dataclass(frozen=True)
class Adapted:
    """A scene after optimisation.

    Where the Gaussians were optimised themselves, `memories` no longer decode to them. Elsewhere `gaussians` are the
    decoded ones that are `kept` (all where it is None), without `idle_bands`. `cameras` are those of the input views,
    `exposures` their colour transforms (None: the photos show the scene's own colours).
    """

    memories: Memories
    gaussians: Gaussians
    cameras: Cameras
    runs: tuple[tuple[TtoRun, TtoResult], ...]
    kept: Bool[Tensor, "n"] | None = None
    pruned: Pruned | None = None
    idle_bands: IdleBands | None = None
    exposures: Exposures | None = None

    @property
    def interrupted(self) -> bool:
        return any(result.interrupted for _, result in self.runs)


def adapt(
    model: QuerySplat,
    start: Start[Memories | Features],
    target: RenderingLoss,
    plan: Sequence[TtoRun],
    options: OptimiseOptions,
    progress: Callable[[TtoStep], None] = lambda step: None,
    look: Look = lambda gaussians: None,
) -> Adapted:
    """Carry out the runs of `plan`, at least one; a run that Ctrl-C interrupts is the last.

    An automatic amount is pruned during the first run. A number of Gaussians is pruned before it, and so is any amount
    where Gaussians will be split.
    """
    generator = torch.Generator().manual_seed(options.seed)
    callbacks = Callbacks(progress, pruning_to(options.prune, len(target.views)), look)
    pruned: Pruned | None = None
    if callbacks.prune and (options.prune != "auto" or options.densify_to):
        pruned = callbacks.prune(gaussians_of(model, start), target, float(sum(run.settings.steps for run in plan)))
        start, callbacks = start.narrowed(pruned.kept), replace(callbacks, prune=None)
    runs: list[tuple[TtoRun, TtoResult]] = []
    for run in plan:
        result = _run(model, start, target, run, options, generator, callbacks)
        if run.space == "features":
            start = replace(start, variables=result.variables)
            if result.pruned:
                start = start.narrowed(result.pruned.kept)
        pruned, callbacks = result.pruned or pruned, replace(callbacks, prune=None)
        start = replace(start, gaussians=result.gaussians)
        target = replace(target, cameras=result.cameras)
        runs.append((run, result))
        if result.interrupted:
            break
    memories = memories_of(model, start)
    exposures = target.exposures.current if target.exposures else None
    gaussians = gaussians_of(model, start)
    return Adapted(memories, gaussians, target.cameras, tuple(runs), start.kept, pruned, exposures=exposures)


def _run(
    model: QuerySplat,
    start: Start[Memories | Features],
    target: RenderingLoss,
    run: TtoRun,
    options: OptimiseOptions,
    generator: torch.Generator,
    callbacks: Callbacks,
) -> TtoResult:
    if run.space == "features":
        return optimise_memories(
            model,
            start,
            target,
            run.settings,
            generator=generator,
            callbacks=callbacks,
            refine_cameras=options.refine_cameras,
        )
    return optimise_gaussians(
        gaussians_of(model, start),
        target,
        run.settings,
        generator=generator,
        callbacks=callbacks,
        densify_to=options.densify_to,
        refine_cameras=options.refine_cameras,
    )
