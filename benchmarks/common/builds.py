"""Scenes as `reconstruct` makes them, from samples that keep what the encoder found."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from common.samples import SEED, posed
from querysplat_cli.model.memories import Features, Memories
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.pipeline.build import BuiltScene, build_scene
from querysplat_cli.pipeline.optimise import optimise_start
from querysplat_cli.pipeline.settings import ReconstructSettings
from querysplat_cli.runtime.choices import Amount
from querysplat_cli.runtime.progress import StageProgress, silent
from querysplat_cli.training.passes import Sample
from querysplat_cli.tto.adapt import Adapted
from querysplat_cli.tto.features import Start
from querysplat_cli.tto.options import OptimiseOptions

import torch

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


def optimised_again(model: QuerySplat, scene: BuiltScene, prune: Amount, **changes: Any) -> Adapted:
    """The same queries and colour transforms, optimised with `changes` to the settings of the scene's run.

    They are pruned on the way. With `prune` "off" all SH bands stay, too.
    """
    run, _ = scene.adapted.runs[0]
    plan = (replace(run, settings=replace(run.settings, **changes)),)
    options = OptimiseOptions(prune=prune, keep_all=prune == "off", seed=SEED)
    photos, progress = (scene.posed.views, scene.posed.cameras), StageProgress(silent, None)
    exposures = scene.colours.needed if scene.colours else None
    return optimise_start(model, start_of(scene), photos, plan, options, progress, exposures)
