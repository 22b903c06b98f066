"""The gradient of one sample, computed in the memory of a few rendered views."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from querysplat_cli.model.anchors import Anchors
from querysplat_cli.model.memories import attended_rows
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.queries.build import build_anchors
from querysplat_cli.queries.refine import refinements
from querysplat_cli.queries.rendering_error import with_rendering_error
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.splat.lpips import Perceptual
from querysplat_cli.splat.render import RenderSettings, render
from querysplat_cli.training.config import TrainConfig
from querysplat_cli.training.losses import (
    chamfer,
    depth_points,
    draw_indices,
    opacity_floor,
    picture_loss,
)
from querysplat_cli.training.passes import Sample
from querysplat_cli.training.schedule import Weights
from querysplat_cli.training.visibility import unseen_loss
from querysplat_cli.tto.variables import finite


@dataclass(frozen=True)
class StepSettings:
    """What the samples of one training step share.

    `share` scales each sample's gradient. A sample whose picture loss `counts` rejects gives no gradient.
    `perceptual` is LPIPS, or None without its weights.
    """

    config: TrainConfig
    weights: Weights
    share: float = 1.0
    counts: Callable[[float], bool] = lambda loss: True
    perceptual: Perceptual | None = None


@dataclass(frozen=True)
class SampleLoss:
    """`parts` are the losses before their weights. `skipped` is the reason why the sample gave no gradient, or ""."""

    total: float
    parts: dict[str, float]
    psnr: float
    gaussians: int
    skipped: str = ""

    @property
    def pictures(self) -> float:
        """The reconstruction loss without the regularisers; NaN where there were no pictures."""
        return self.parts.get("pictures", math.nan)


def anchored(sample: Sample) -> Anchors:
    """The anchors of the inputs, with the rendering error of their prior in the inputs."""
    anchors, _ = build_anchors(sample.views, sample.cameras, sample.geometry)
    return with_rendering_error(anchors, sample.views, sample.cameras)


def decoded(model: QuerySplat, sample: Sample, anchors: Anchors | None, precision: str) -> Iterator[Gaussians]:
    """Gaussians of the inputs alone, in float32, with a graph back to the weights.

    There is one scene, or, with rounds of refinement, that of each round. The lower precision is that of the model
    alone: what the caller does with a scene has its own. Raises QuerySplatError where the model cannot read the
    encoder's features.
    """
    scenes = _scenes(model, sample, anchors)
    while True:
        # Not around a yield: rendering and losses of the caller would be in bf16, too.
        with torch.autocast(sample.views.images.device.type, torch.bfloat16, enabled=precision == "bf16"):
            scene = next(scenes, None)
        if scene is None:
            return
        yield scene.map(Tensor.float)


def _scenes(model: QuerySplat, sample: Sample, anchors: Anchors | None) -> Iterator[Gaussians]:
    geometry = sample.geometry
    model.check_features(geometry.features, *sample.views.images.shape[-2:])
    features = model.embed(geometry.features, sample.views.images, sample.cameras)
    if anchors is not None:
        features, anchors, _ = attended_rows(features, anchors)
    memories = model.keys_and_values(features)
    if anchors is None or not model.config.refinement_rounds:
        yield model.decode(memories, anchors)
        return
    for each in refinements(model, memories, anchors, sample.views, sample.cameras, geometry):
        yield each.scene


def add_gradient(
    model: QuerySplat,
    sample: Sample,
    anchors: Anchors | None,
    step: StepSettings,
    generator: torch.Generator,
) -> SampleLoss:
    """Add `step.share` times the gradient of the sample's loss to the gradients of the model's weights.

    Views are rendered a few at once. Their gradients with respect to the Gaussians are summed first, and go through
    the model once. Nothing is added where a Gaussian, the loss or a gradient is not finite, or where
    `step.counts(picture loss)` is False. The loss of rounds of refinement is the mean of theirs; the result is that of
    the last round.
    """
    found: list[tuple[Gaussians, list[Tensor]]] = []
    for gaussians in decoded(model, sample, anchors, step.config.optimiser.precision):
        result, gradients = _graded(gaussians, sample, step, generator)
        if result.skipped:
            return result
        found.append((gaussians, gradients))
    for gaussians, gradients in found:
        share = step.share / len(found)
        torch.autograd.backward(gaussians.tensors(), [share * gradient for gradient in gradients])
    return result


def _graded(
    gaussians: Gaussians, sample: Sample, step: StepSettings, generator: torch.Generator
) -> tuple[SampleLoss, list[Tensor]]:
    """The loss of a scene, and its gradient with respect to the Gaussians."""
    leaves = gaussians.map(lambda field: field.detach().requires_grad_())
    if not finite(leaves.tensors()):
        return SampleLoss(math.nan, {}, math.nan, len(gaussians), "Gaussians are not finite"), []
    pictures, psnr = _pictures(leaves, sample, step, generator)
    parts = {"pictures": pictures, **_regularise(leaves, sample, step, generator)}
    total = sum(getattr(step.weights, name, 1.0) * value for name, value in parts.items())
    gradients = [torch.zeros_like(leaf) if leaf.grad is None else leaf.grad for leaf in leaves.tensors()]
    skipped = ""
    if not math.isfinite(total) or not finite(gradients):
        skipped = "the loss or its gradient is not finite"
    elif not step.counts(pictures):
        skipped = "its loss ranks too high"
    return SampleLoss(total, parts, psnr, len(gaussians), skipped), gradients


def _pictures(leaves: Gaussians, sample: Sample, step: StepSettings, generator: torch.Generator) -> tuple[float, float]:
    """Mean picture loss and PSNR (dB) of the targets; the gradient is added to that of `leaves`."""
    count, at_once = len(sample.targets), step.config.optimiser.views_at_once
    given = step.config.losses.background
    background = torch.rand(3, generator=generator) if given == "random" else torch.full((3,), given)
    total, decibels = 0.0, 0.0
    for start in range(0, count, at_once):
        rows = list(range(start, min(start + at_once, count)))
        photos, cameras = sample.targets[rows], sample.target_cameras[rows]
        picture = render(leaves, cameras, background=background).colour
        loss = picture_loss(picture, photos.images, photos.masks, step.perceptual, step.weights.perceptual)
        loss = loss * len(rows) / count
        loss.backward()
        total += float(loss.detach())
        with torch.no_grad():
            for image, photo, mask in zip(picture.clamp(0, 1), photos.images, photos.masks, strict=True):
                error = (image - photo).square().mean(0)[mask].mean()
                decibels -= 10 * math.log10(max(float(error), 1e-10)) / count
    return total, decibels


def _regularise(leaves: Gaussians, sample: Sample, step: StepSettings, generator: torch.Generator) -> dict[str, float]:
    """The losses of the Gaussians themselves that have a weight; the gradient is added to that of `leaves`."""
    losses: dict[str, Tensor] = {}
    weights, settings = step.weights, step.config.losses
    if weights.visibility:
        views = sample.cameras, sample.target_cameras
        losses["visibility"] = unseen_loss(leaves.means, views, RenderSettings().near, settings.visibility_limit)
    if weights.opacity_floor:
        losses["opacity_floor"] = opacity_floor(leaves.opacities, settings.alpha_min)
    if weights.chamfer and sample.geometry.depth is not None:
        count = settings.chamfer_points
        points = depth_points(sample.views, sample.cameras, sample.geometry.depth, count, generator)
        losses["chamfer"] = chamfer(leaves.means[draw_indices(len(leaves), count, generator)], points)
    for name, loss in losses.items():
        (getattr(weights, name) * loss).backward()
    return {name: float(loss.detach()) for name, loss in losses.items()}
