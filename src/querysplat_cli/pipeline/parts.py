"""The model and the encoder of a reconstruction."""

from dataclasses import replace
from pathlib import Path

import torch

from querysplat_cli.encoders.base import Encoder, EncoderOptions
from querysplat_cli.encoders.registry import find_encoder
from querysplat_cli.model.checkpoints import load
from querysplat_cli.model.config import preset_names
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.pipeline.settings import ReconstructSettings
from querysplat_cli.runtime.precision import check_precision


def load_parts(settings: ReconstructSettings, device: torch.device) -> tuple[QuerySplat, Encoder]:
    """The model and its encoder: by default the encoder that the model was trained with."""
    precision = check_precision(settings.precision)
    model = load(settings.preset, settings.weights, precision=precision, device=device)
    learned = model.config.queries == "learned"
    if learned and settings.queries:
        model.keep_queries(settings.queries)
    depth, frame = settings.depth or not learned, model.config.frame
    options = EncoderOptions(
        settings.weights,
        device,
        precision,
        settings.fit,
        model.layer_weights,
        depth=depth,
        matcher=settings.matcher,
        frame=frame,
    )
    return model, find_encoder(settings.encoder or ("vggt_omega" if learned else "classical"), options)


def with_absolute_parts(settings: ReconstructSettings) -> ReconstructSettings:
    """The settings with absolute paths of a checkpoint, of weights and of depth maps.

    The scene may be taken further elsewhere, and workers make its regions in other folders.
    """
    preset = settings.preset
    if preset not in preset_names() and Path(preset).is_file():
        preset = str(Path(preset).absolute())
    paths = settings.weights, settings.lpips, settings.depth_maps
    weights, lpips, depth_maps = (path and path.absolute() for path in paths)
    return replace(settings, preset=preset, weights=weights, lpips=lpips, depth_maps=depth_maps)
