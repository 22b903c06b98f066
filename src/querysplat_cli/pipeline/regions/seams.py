"""Where two regions meet, how well they agree; and the last optimisation, after which seams are not seen."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import torch

from querysplat_cli.pipeline.full_size import LargePhotos
from querysplat_cli.pipeline.policy import PIPELINE_POLICY
from querysplat_cli.pipeline.regions.groups import Group
from querysplat_cli.runtime.errors import ImpossibleScene
from querysplat_cli.runtime.progress import Progress
from querysplat_cli.runtime.sequences import evenly_spaced
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.paths import halfway
from querysplat_cli.splat.blending_weights import blending_weights
from querysplat_cli.splat.conventions import MID_GREY
from querysplat_cli.splat.render import render
from querysplat_cli.tto.full_size import full_size_loss
from querysplat_cli.tto.full_size_policy import FULL_SIZE_POLICY
from querysplat_cli.tto.gaussians import optimise_gaussians
from querysplat_cli.tto.optimise import TtoResult
from querysplat_cli.tto.options import Callbacks, TtoSettings
from querysplat_cli.tto.plan import TtoRun


@dataclass(frozen=True)
class Seam:
    """Two regions (by number, from 0) and the photos that both were made of, by row number."""

    regions: tuple[int, int]
    photos: tuple[int, ...]


def find_seams(groups: Sequence[Group]) -> list[Seam]:
    """Every two groups that have photos in common."""
    found = []
    for one, other in combinations(range(len(groups)), 2):
        photos = sorted(set(groups[one].rows) & set(groups[other].rows))
        if photos:
            found.append(Seam((one, other), tuple(photos)))
    return found


@torch.no_grad()
def disagreement(seam: Seam, cameras: Cameras, sizes: Sequence[tuple[int, int]], scenes: Sequence[Gaussians]) -> float:
    """The PSNR in dB between pictures of two regions, from places halfway between two common photos.

    The two are neighbours: the middle between others may lie in what they show. `scenes` are those of the regions of
    `seam`, whole. No photo was taken there, so both have to be right to agree. Pixels that either leaves empty do not
    count, nor those of the canvas beyond the smallest of the common photos; `sizes` are (height, width) of all photos.
    """
    between = halfway(cameras[list(seam.photos)])
    height, width = (min(side) for side in zip(*(sizes[row] for row in seam.photos), strict=True))
    between = replace(between, height=height, width=width)
    some = evenly_spaced(range(len(between)), PIPELINE_POLICY.seam_views)
    errors, count = 0.0, 0
    for view in some:
        drawn = [render(each, between[[view]]) for each in scenes]
        covered = (drawn[0].alpha[0] > MID_GREY) & (drawn[1].alpha[0] > MID_GREY)
        one, other = (each.over(torch.full((3,), MID_GREY))[0].clamp(0, 1) for each in drawn)
        errors += float((one - other).square().mean(0)[covered].sum())
        count += int(covered.sum())
    return -10 * math.log10(max(errors / count, 1e-10)) if count else 0.0


def verdict(seam: Seam, decibels: float) -> str | None:
    """A warning where the regions of a seam hardly agree; None where they do. `decibels` is their `disagreement`.

    Raises ImpossibleScene where they show different things altogether. 0 dB, where no picture shows both, is a warning.
    """
    one, other = (number + 1 for number in seam.regions)
    if decibels >= PIPELINE_POLICY.bad_seam_psnr:
        return None
    why = f"regions {one} and {other} show different things where they meet ({decibels:.1f} dB)"
    if 0 < decibels < PIPELINE_POLICY.refused_seam_psnr:
        raise ImpossibleScene(f"{why}, so they are not joined", "Use fewer --regions: the cameras are kept for that.")
    return f"{why}: look at the scene there, and use fewer --regions"


def parts_needed(photos: LargePhotos, size: int) -> int:
    """In how many parts the last optimisation takes the photos, at a longer side of `size` pixels."""
    growth = max(1.0, size / photos.working) ** 2
    pixels = growth * sum(height * width for height, width in photos.views.sizes)
    return math.ceil(max(pixels / PIPELINE_POLICY.joint_pixels, len(photos.views) / PIPELINE_POLICY.joint_photos))


def smoothed(
    rows: Sequence[int], photos: LargePhotos, size: int, gaussians: Gaussians, *, seed: int, progress: Progress
) -> tuple[Gaussians, TtoRun, TtoResult]:
    """The scene after some steps on the photos of these rows, at a longer side of `size` pixels.

    Only the Gaussians that these photos show change. All photos that show them should take part: what a photo outside
    of `rows` shows as well becomes worse there.
    """
    some = photos.some(rows)
    shown = blending_weights(gaussians, some.cameras) > 0
    views, cameras = some.at(size)
    if some.exposures:
        views = some.exposures.removed_from(views)
    settings = TtoSettings(
        PIPELINE_POLICY.joint_passes * len(rows),
        PIPELINE_POLICY.joint_rate * FULL_SIZE_POLICY.learning_rate,
        views_per_step=1,
    )
    generator = torch.Generator().manual_seed(seed)
    target = full_size_loss(views, cameras, some.confirmed_pictures(), generator)
    taken = iter(range(1, settings.steps + 1))
    callbacks = Callbacks(lambda step: progress(f"{step.psnr:.2f} dB", next(taken, settings.steps) / settings.steps))
    result = optimise_gaussians(gaussians[shown], target, settings, generator=generator, callbacks=callbacks)
    changed = gaussians.map(torch.Tensor.clone)
    for field, new in vars(result.gaussians).items():
        getattr(changed, field)[shown] = new.detach()
    return changed, TtoRun("gaussians", settings), result
