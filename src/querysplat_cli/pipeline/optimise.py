"""The optimisation stage, which a new scene and a stored one have in common."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import count

import torch

from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.prune.bands import without_idle_bands
from querysplat_cli.prune.far import drawn_in
from querysplat_cli.runtime.device import to_device
from querysplat_cli.runtime.progress import Progress, StageProgress
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.exposures import Exposures
from querysplat_cli.scene.views import Views
from querysplat_cli.splat.conventions import MID_GREY, RELEASE
from querysplat_cli.splat.smoothing import bounded
from querysplat_cli.tto.adapt import Adapted, adapt
from querysplat_cli.tto.exposure_refit import RefittedExposures
from querysplat_cli.tto.features import Start
from querysplat_cli.tto.options import OptimiseOptions, TtoStep
from querysplat_cli.tto.plan import TtoRun
from querysplat_cli.tto.pruning import tested_views
from querysplat_cli.tto.rendering_loss import RenderingLoss


def optimise_start(
    model: QuerySplat,
    start: Start,
    photos: tuple[Views, Cameras],
    plan: Sequence[TtoRun],
    options: OptimiseOptions,
    progress: StageProgress,
    exposures: Exposures | None = None,
) -> Adapted:
    """Carry out `plan` on the device of the model, and leave out SH bands that change nothing; the result on the CPU.

    Its Gaussians are nowhere thinner than the pixels of the finest photo that sees them, and far ones are drawn in.
    Scenes of official models have no such bounds, keep all bands, and all Gaussians unless a number is asked for, and
    are optimised over mid-grey, as in the release. Scenes of larger photos (`options.finest_size`) keep all bands, too:
    small pictures do not tell what these are worth there. `exposures` are the colour transforms of the photos to start
    with.
    """
    if options.keep_all or start.anchors is None:
        options = replace(options, keep_all=True, prune="off" if options.prune == "auto" else options.prune)
    device = next(model.parameters()).device
    if isinstance(options.perceptual, torch.nn.Module):
        options = replace(options, perceptual=options.perceptual.to(device))
    start, (views, cameras) = to_device((start, photos), device)
    target = rendering_target(views, cameras, options, exposures, official=start.anchors is None)
    if target.finest and (options.smooth or any(run.settings.steps for run in plan)):
        start = replace(start, finest=target.finest)
    look = partial(progress.look, views=photos[0], cameras=photos[1])
    adapted = adapt(model, start, target, plan, options, _shown(plan, progress), look)
    if target.finest is not None:
        finest = _enlarged(adapted.cameras, options.finest_size)
        adapted = replace(adapted, gaussians=bounded(drawn_in(adapted.gaussians, adapted.cameras), finest))
    if not options.keep_all and options.finest_size is None:
        last, tested = replace(target, cameras=adapted.cameras), tested_views(len(target.views))
        fewer, idle = without_idle_bands(adapted.gaussians, lambda some: last.psnr(some, tested))
        adapted = replace(adapted, gaussians=fewer, idle_bands=idle)
    return to_device(adapted, torch.device("cpu"))


def rendering_target(
    views: Views, cameras: Cameras, options: OptimiseOptions, exposures: Exposures | None, *, official: bool
) -> RenderingLoss:
    """What the renders of a scene are compared with, and how; `official` models have the loss of the release."""
    if official:
        grey = torch.full((3,), MID_GREY, device=cameras.w2c.device)
        return RenderingLoss(views, cameras, grey, RELEASE, perceptual=options.perceptual)
    backgrounds = torch.Generator().manual_seed(options.seed)
    refitted = RefittedExposures(exposures) if exposures else None
    target = RenderingLoss.for_solid_scenes(views, cameras, backgrounds, refitted)
    return replace(target, finest=_enlarged(cameras, options.finest_size), perceptual=options.perceptual)


def _enlarged(cameras: Cameras, longer_side: int | None) -> Cameras:
    """`cameras` whose pictures have that longer side; the same ones for None."""
    factor = 1.0 if longer_side is None else longer_side / max(cameras.height, cameras.width)
    return cameras.resized(round(factor * cameras.height), round(factor * cameras.width))


def _shown(plan: Sequence[TtoRun], progress: Progress) -> Callable[[TtoStep], None]:
    """A callback that reports every step as a share of all that are planned."""
    total, taken = sum(run.settings.steps for run in plan), count(1)

    def show(step: TtoStep) -> None:
        progress(f"loss {step.loss:.4f}, {step.psnr:.2f} dB, {step.gaussians:,} Gaussians", next(taken) / total)

    return show
