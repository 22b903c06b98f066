"""Test-time optimisation as a scene gets it: in feature space, in Gaussian space, or one after the other."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool
from torch import Tensor

from querysplat_cli.model.anchors import Anchors
from querysplat_cli.model.memories import Features, Memories
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.prune.bands import IdleBands
from querysplat_cli.prune.gaussians import Pruned
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.tto.features import decoded, optimise_memories
from querysplat_cli.tto.gaussians import optimise_gaussians
from querysplat_cli.tto.optimise import Pruning, TtoResult, TtoStep
from querysplat_cli.tto.plan import TtoRun
from querysplat_cli.tto.rendering_loss import RenderingLoss


@dataclass(frozen=True)
class Adapted:
    """What became of a scene. Where the Gaussians were optimised themselves, `memories` no longer decode to them;
    elsewhere `gaussians` are the decoded ones that are `kept` (all where it is None), without `idle_bands`. `cameras`
    are those of the input views."""

    memories: Memories
    gaussians: Gaussians
    cameras: Cameras
    runs: tuple[tuple[TtoRun, TtoResult], ...]
    kept: Bool[Tensor, "n"] | None = None
    pruned: Pruned | None = None
    idle_bands: IdleBands | None = None

    @property
    def interrupted(self) -> bool:
        return any(result.interrupted for _, result in self.runs)


@dataclass(frozen=True)
class Start:
    """What there is to optimise. `gaussians` is the scene where it is no longer what the memories decode to;
    `kept` says which of the decoded ones are the scene's (None: all)."""

    variables: Memories | Features
    anchors: Anchors | None
    gaussians: Gaussians | None = None
    kept: Bool[Tensor, "n"] | None = None


def adapt(
    model: QuerySplat,
    start: Start,
    target: RenderingLoss,
    plan: Sequence[TtoRun],
    *,
    generator: torch.Generator,
    progress: Callable[[TtoStep], None] = lambda step: None,
    pruning: Pruning | None = None,
    at_once: bool = False,
    densify_to: int | None = None,
    refine_cameras: bool = False,
) -> Adapted:
    """Go through the runs of `plan`, at least one; an interrupted one is the last.

    The first prunes on the way; where that must not depend on what optimisation brings, or Gaussians are to be split
    until there are `densify_to`, it is done `at_once`. Only runs in Gaussian space split.
    """
    variables, anchors, gaussians, kept = start.variables, start.anchors, start.gaussians, start.kept
    pruned: Pruned | None = None
    if pruning and (at_once or densify_to):
        with torch.no_grad():
            everything = decoded(model, variables, anchors, kept) if gaussians is None else gaussians
        pruned, pruning = pruning(everything, target, 0.0), None
        if gaussians is None:
            kept = _narrowed(kept, pruned.kept)
        else:
            gaussians = gaussians[pruned.kept]
    runs: list[tuple[TtoRun, TtoResult]] = []
    for run in plan:
        result: TtoResult
        if run.space == "features":
            result = optimise_memories(
                model,
                variables,
                anchors,
                target,
                run.settings,
                generator=generator,
                progress=progress,
                kept=kept,
                pruning=pruning,
                refine_cameras=refine_cameras,
            )
            variables = result.variables
            if result.pruned:
                kept = _narrowed(kept, result.pruned.kept)
        else:
            if gaussians is None:
                with torch.no_grad():
                    gaussians = decoded(model, variables, anchors, kept)
            result = optimise_gaussians(
                gaussians,
                target,
                run.settings,
                generator=generator,
                progress=progress,
                pruning=pruning,
                densify_to=densify_to,
                refine_cameras=refine_cameras,
            )
        pruned, pruning = result.pruned or pruned, None
        gaussians = result.gaussians
        target = replace(target, cameras=result.cameras)
        runs.append((run, result))
        if result.interrupted:
            break
    assert gaussians is not None
    memories = variables if isinstance(variables, Memories) else model.keys_and_values(variables)
    return Adapted(memories, gaussians, target.cameras, tuple(runs), kept, pruned)


def _narrowed(kept: Bool[Tensor, "n"] | None, among_them: Bool[Tensor, "m"]) -> Bool[Tensor, "n"]:
    if kept is None:
        return among_them
    narrower = kept.clone()
    narrower[kept] = among_them
    return narrower
