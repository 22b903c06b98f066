"""Scenes as `reconstruct` makes them, from samples that keep what the encoder found."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from common.samples import SEED, posed
from querysplat_cli.model.memories import Features, Memories
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.pipeline.build import BuiltScene, build_scene
from querysplat_cli.pipeline.settings import ReconstructSettings
from querysplat_cli.runtime.choices import Amount
from querysplat_cli.training.passes import Sample
from querysplat_cli.tto.features import Start, optimise_memories
from querysplat_cli.tto.optimise import TtoResult
from querysplat_cli.tto.options import Callbacks
from querysplat_cli.tto.pruning import pruning_to
from querysplat_cli.tto.rendering_loss import RenderingLoss

UNLIMITED = 10**9
"""As a limit of queries: more than any photos need, so that a query stands for every smallest block."""


def settings(**changes: Any) -> ReconstructSettings:
    """Those of `reconstruct` by default, with `changes`; nothing is read or written by their paths.

    There is no backdrop, so that scenes can be compared with others that come from the optimiser alone.
    """
    return replace(ReconstructSettings((), Path(), seed=SEED, backdrop=False), **changes)


def build(model: QuerySplat, sample: Sample, **changes: Any) -> BuiltScene:
    """The scene of a sample, with `changes` to the default settings."""
    return build_scene(posed(sample), sample.geometry, model, settings(**changes))


def start_of(scene: BuiltScene) -> Start[Memories | Features]:
    """The queries and memories of a scene before optimisation."""
    return Start(scene.prepared.variables.map(torch.Tensor.float), scene.prepared.anchors)


def optimised_again(model: QuerySplat, scene: BuiltScene, prune: Amount, **changes: Any) -> TtoResult:
    """The same queries, optimised with `changes` to the settings of the scene's run, and pruned on the way."""
    views = scene.posed.views
    run, _ = scene.adapted.runs[0]
    return optimise_memories(
        model,
        replace(start_of(scene), finest=scene.posed.cameras),
        RenderingLoss.for_solid_scenes(views, scene.posed.cameras, torch.Generator().manual_seed(SEED)),
        replace(run.settings, **changes),
        generator=torch.Generator().manual_seed(SEED),
        callbacks=Callbacks(prune=pruning_to(prune, len(views))),
    )
