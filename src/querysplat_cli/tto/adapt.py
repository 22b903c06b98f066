"""Test-time optimisation as a scene gets it: in feature space, in Gaussian space, or one after the other."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch

from querysplat_cli.model.anchors import Anchors
from querysplat_cli.model.memories import Features, Memories
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.tto.features import optimise_memories
from querysplat_cli.tto.gaussians import optimise_gaussians
from querysplat_cli.tto.optimise import TtoResult, TtoStep
from querysplat_cli.tto.plan import TtoRun
from querysplat_cli.tto.rendering_loss import RenderingLoss


@dataclass(frozen=True)
class Adapted:
    """What became of a scene. Where the Gaussians were optimised themselves, `memories` no longer decode to them."""

    memories: Memories
    gaussians: Gaussians
    runs: tuple[tuple[TtoRun, TtoResult], ...]

    @property
    def interrupted(self) -> bool:
        return any(result.interrupted for _, result in self.runs)


def adapt(
    model: QuerySplat,
    variables: Memories | Features,
    anchors: Anchors | None,
    gaussians: Gaussians | None,
    target: RenderingLoss,
    plan: Sequence[TtoRun],
    *,
    generator: torch.Generator,
    progress: Callable[[TtoStep], None] = lambda step: None,
) -> Adapted:
    """Go through the runs of `plan`, at least one; an interrupted one is the last.

    `gaussians` is the scene where it is no longer what the memories decode to.
    """
    runs: list[tuple[TtoRun, TtoResult]] = []
    for run in plan:
        result: TtoResult
        if run.space == "features":
            result = optimise_memories(
                model, variables, anchors, target, run.settings, generator=generator, progress=progress
            )
            variables = result.variables
        else:
            start = _decode(model, variables, anchors) if gaussians is None else gaussians
            result = optimise_gaussians(start, target, run.settings, generator=generator, progress=progress)
        gaussians = result.gaussians
        runs.append((run, result))
        if result.interrupted:
            break
    assert gaussians is not None
    memories = variables if isinstance(variables, Memories) else model.project(variables)
    return Adapted(memories, gaussians, tuple(runs))


@torch.no_grad()
def _decode(model: QuerySplat, variables: Memories | Features, anchors: Anchors | None) -> Gaussians:
    return model.decode(variables, anchors)
