"""The story of `reconstruct`, and of taking a scene up again: photos in, scene out."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import torch

from querysplat_cli.encoders.base import Encoder, EncoderOptions, Geometry, PosedViews
from querysplat_cli.encoders.holdout import CameraPass, camera_passes, take
from querysplat_cli.encoders.registry import find_encoder
from querysplat_cli.model.checkpoints import load
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.pipeline.budget import Budget, optimising_seconds, working_size
from querysplat_cli.pipeline.memory import MemoryNeeds, evenly_spaced, within_memory
from querysplat_cli.pipeline.scene_folder import StoredScene, ply_path, read_scene, scene_folder, write_scene
from querysplat_cli.pipeline.settings import ReconstructSettings
from querysplat_cli.prune.bands import without_idle_bands
from querysplat_cli.prune.gaussians import Pruned, prune, target_count
from querysplat_cli.prune.resolution import Blurred, blurred
from querysplat_cli.prune.views import near_duplicates
from querysplat_cli.queries.prepare import PreparedQueries, prepare
from querysplat_cli.reporting import omissions as omissions
from querysplat_cli.reporting.report import (
    Report,
    heldout_entry,
    machine,
    quality_entry,
    seconds_entry,
    tto_entries,
    views_entry,
)
from querysplat_cli.reporting.view_scores import Quality, score
from querysplat_cli.runtime.choices import Amount, Space
from querysplat_cli.runtime.device import find_device, free_bytes, peak_gib, to_device
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.precision import check_precision, matrix_products
from querysplat_cli.runtime.progress import Progress, Stages
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.files import check_writable, refuse_existing, refuse_replacing
from querysplat_cli.scene.formats.known import read_known_cameras
from querysplat_cli.scene.formats.ply import read_ply
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.photos import find_photos, load_photos
from querysplat_cli.scene.views import LeftOut, Photo, Views
from querysplat_cli.splat.compile_ahead import compile_ahead
from querysplat_cli.tto.adapt import Adapted, Start, adapt
from querysplat_cli.tto.cameras import refinable, with_refined_focal
from querysplat_cli.tto.optimise import TtoStep
from querysplat_cli.tto.plan import QUERIES, RELEASE_STEPS, TtoRun, plan_release, plan_tto
from querysplat_cli.tto.rendering_loss import RenderingLoss

MISFIT = 0.5
"""Pixels from their epipolar lines at which the median match must lie for cameras to be refined: structure from motion
leaves at most 0.24 on the six sets, known cameras that are turned by a pixel at least 0.74."""
TESTED_VIEWS = 8
"""What leaving something out costs is measured on at most so many input views, evenly spaced."""


@dataclass(frozen=True)
class BuiltScene:
    """A scene and what it was made of; cameras are those before optimisation, which may have corrected them.
    `duplicates` are views that were left out of it; `time_for_more` says whether the budget has room for another
    scene."""

    posed: PosedViews
    duplicates: tuple[LeftOut, ...]
    geometry: Geometry
    prepared: PreparedQueries
    adapted: Adapted
    time_for_more: bool = True

    def heldout(self, cameras: CameraPass) -> tuple[Views, Cameras] | None:
        """The held-out views of the pass that the scene was made from, with cameras corrected as the inputs' were."""
        if cameras.heldout is None:
            return None
        views, theirs = cameras.heldout
        return views, with_refined_focal(theirs, self.posed.cameras, self.adapted.cameras)


def reconstruct(settings: ReconstructSettings, stages: Stages) -> Report:
    """Photos to `settings.ply` and the scene folder beside it.

    Raises QuerySplatError on bad input and ImpossibleScene when the photos do not make a scene; nothing is
    written then.
    """
    outputs = [settings.ply, scene_folder(settings.ply)]
    refuse_replacing(settings.inputs, outputs)
    refuse_existing(outputs, force=settings.force)
    check_writable(settings.ply.parent)
    device = find_device(settings.device)
    with matrix_products(check_precision(settings.precision)):
        return _reconstruct(settings, device, stages)


def _reconstruct(settings: ReconstructSettings, device: torch.device, stages: Stages) -> Report:
    free = free_bytes(device)
    with stages("photos") as progress:
        photos, unread = load_photos(find_photos(settings.inputs), progress=progress)
    if device.type == "cpu":
        compile_ahead()
    with stages("model") as progress:
        model, encoder = load_parts(settings, device)
        known = read_known_cameras(settings.poses) if settings.poses else None
        budget = Budget(settings.budget, stages.elapsed) if settings.budget else None
        size = settings.max_size or encoder.size
        adjustable = encoder.name == "classical" and not settings.max_size
        finest = blurred(photos, size) if adjustable and not settings.keep_everything else None
        size = finest.size if finest else size
        if budget and adjustable:
            largest = max(photos, key=lambda photo: photo.height * photo.width)
            scenes = 1 if settings.holdout_every is None or known else 2
            size = working_size(budget, len(photos), scenes, (largest.height, largest.width), size)
        needs = MemoryNeeds(encoder, model, size, optimising=bool(settings.tto))
        photos, too_many, expected = within_memory(photos, needs, free, settings.max_views)
        if expected:
            progress(f"{len(photos)} views will take about {expected / 2**30:.1f} GiB", 1.0)

    def estimate_cameras(chosen: Sequence[Photo]) -> PosedViews:
        with stages("cameras") as progress:
            return encoder.estimate_cameras(chosen, max_size=size, seed=settings.seed, known=known, progress=progress)

    passes = camera_passes(
        photos,
        settings.holdout_every,
        settings.holdout_cameras,
        estimate_cameras,
        poses_known=bool(known),
        own_frame=encoder.own_frame,
    )
    scenes = 2 if passes.other and passes.other.heldout else 1
    scene = build_scene(
        passes.chosen.inputs, encoder, model, settings, stages, last=passes.other is None, budget=budget, scenes=scenes
    )
    with stages("score"):
        quality = score(scene.adapted.gaussians, scene.posed.views, scene.adapted.cameras)
        scores = {passes.chosen.source: _score_heldout(scene, passes.chosen)}
    if passes.other and passes.other.heldout and scene.time_for_more and not scene.adapted.interrupted:
        with stages(f"{passes.other.source} score"):
            second = build_scene(passes.other.inputs, encoder, model, settings, Stages(), budget=budget)
            if not second.adapted.interrupted:
                scores[passes.other.source] = _score_heldout(second, passes.other)
    with stages("write"):
        report = Report(
            ply=str(settings.ply),
            scene=str(scene_folder(settings.ply)),
            views=views_entry(scene.posed.views.names, (*unread, *too_many, *passes.left_out, *scene.duplicates)),
            gaussians=len(scene.adapted.gaussians),
            seconds=seconds_entry(stages.seconds),
            quality={
                "input": quality_entry(quality),
                "heldout": heldout_entry(passes.chosen.source, scores, passes.difference),
            },
            left_out=[asdict(saving) for saving in _savings(settings, scene, finest)],
            warnings=[*passes.warnings, *scene.geometry.warnings],
            tto=tto_entries(scene.adapted.runs),
            settings={
                key: value if isinstance(value, int | None) else str(value) for key, value in asdict(settings).items()
            },
            peak_memory_gib=round(peak_gib(), 2),
            machine=machine(),
            memory_estimate_gib=expected and round(expected / 2**30, 2),
        )
        stored = StoredScene(
            scene.posed.views,
            scene.adapted.cameras,
            scene.heldout(passes.chosen),
            scene.adapted.memories,
            scene.prepared.anchors,
            settings.preset,
            scene.prepared.map,
            scene.adapted.kept,
        )
        write_scene(settings.ply, stored, scene.adapted.gaussians, report.as_dict())
    return report


def load_parts(settings: ReconstructSettings, device: torch.device) -> tuple[QuerySplat, Encoder]:
    """The model, and the encoder that feeds it: by default the one that it was made for."""
    precision = check_precision(settings.precision)
    model = load(settings.preset, settings.weights, precision=precision, device=device)
    learned = model.config.queries == "learned"
    if learned and settings.queries:
        model.keep_queries(settings.queries)
    options = EncoderOptions(
        settings.weights, device, precision, settings.fit, model.layer_weights, depth=settings.depth or not learned
    )
    return model, find_encoder(settings.encoder or ("vggt_omega" if learned else "classical"), options)


def build_scene(
    posed: PosedViews,
    encoder: Encoder,
    model: QuerySplat,
    settings: ReconstructSettings,
    stages: Stages,
    *,
    last: bool = False,
    budget: Budget | None = None,
    scenes: int = 1,
) -> BuiltScene:
    """Depth, queries, memories, test-time optimisation: a scene from photos with cameras.

    After the `last` scene the encoder cannot be used any more: its weights make room for the decoders. Of a
    `budget`, as much is used as leaves time for the rest of the `scenes`.
    """
    before = stages.elapsed()
    posed, duplicates = (posed, ()) if settings.keep_everything else _distinct(posed)
    views, cameras = posed.views, posed.cameras
    with stages("depth") as progress:
        geometry = encoder.estimate_geometry(posed, seed=settings.seed, progress=progress)
    if last:
        encoder.free()
    with stages("queries"):
        prepared = prepare(
            model,
            posed,
            geometry,
            queries=settings.queries,
            about=None if settings.keep_everything or settings.tto == 0 else QUERIES,
            target=settings.tto_target,
            everything=settings.keep_everything,
        )
        geometry = replace(geometry, features=())
    with stages("tto") as progress:
        anchors = prepared.anchors
        config = model.config
        count = config.query_count * config.gaussians_per_query if anchors is None else anchors.opacities.numel()
        seconds, more = None, True
        if budget:
            seconds, enough = optimising_seconds(budget, stages.elapsed() - before, count, scenes)
            more = enough or scenes == 1
        space, amount = settings.tto_space, "off" if settings.keep_everything else settings.prune
        if anchors is None:
            plan = plan_release(settings.tto or 0, space=space, seconds=seconds)
        else:
            stay = target_count(count, amount, cameras)
            plan = plan_tto(settings.tto, views=len(views), gaussians=count, staying=stay, space=space, seconds=seconds)
        steps = sum(run.settings.steps for run in plan)
        variables = prepared.variables.map(torch.Tensor.float) if steps else prepared.variables
        adapted = _optimise(
            model,
            Start(variables, prepared.anchors),
            (views, cameras),
            plan,
            settings.seed,
            amount,
            progress,
            refine_cameras=_refines(settings.refine_cameras, posed),
            everything=settings.keep_everything,
        )
    return BuiltScene(posed, duplicates, geometry, prepared, adapted, more)


def _refines(wanted: bool | None, posed: PosedViews) -> bool:
    """Whether cameras are corrected; by default those that hardly fit, since good ones only follow what optimisation
    makes of the scene (held out, fox loses 0.4 dB)."""
    if wanted is not None:
        return wanted
    return posed.epipolar_error_px is not None and posed.epipolar_error_px > MISFIT and refinable(posed.cameras)


def _distinct(posed: PosedViews) -> tuple[PosedViews, tuple[LeftOut, ...]]:
    """Without the views that show what another one shows, and those."""
    names = posed.views.names
    same = near_duplicates(posed.cameras, posed.points, posed.visibility)
    left_out = tuple(LeftOut(names[view], f"shows what {names[other]} shows") for view, other in same.items())
    return take(posed, [view for view in range(len(names)) if view not in same]), left_out


def optimise_scene(
    path: Path,
    *,
    steps: int | None,
    lr: float | None,
    device: str,
    seed: int,
    stages: Stages,
    space: Space | None = None,
    amount: Amount = "off",
    densify_to: int | None = None,
    refine_cameras: bool = False,
    weights: Path | None = None,
) -> Report:
    """Take up the scene in `path` (its folder or its .ply), optimise it further, and write it back.

    `space` None goes on where the last run worked; `amount` of the Gaussians stay; in Gaussian space they are split
    until there are `densify_to`; `refine_cameras` corrects the cameras, too. `weights` is where the model's files are
    now, if not where they were. Raises QuerySplatError when memories are asked for whose Gaussians have gone their own
    way, and when `densify_to` asks for splitting in feature space or for fewer Gaussians than there are.
    """
    with stages("read"):
        scene, before = read_scene(path)
        model = load_again(scene.model, before["settings"], weights, find_device(device))
        spaces = [run["space"] for run in before["tto"] if run["steps"]]
        chosen = space or (spaces[-1] if spaces else "features")
        apart = "gaussians" in spaces
        if apart and chosen != "gaussians":
            raise QuerySplatError(
                f"the Gaussians of {path} were optimised themselves, and its memories would undo that",
                "Use --space gaussians, or make the scene again.",
            )
        if densify_to is not None and chosen == "features":
            raise QuerySplatError("--densify splits Gaussians, which memories cannot follow", "Use --space gaussians.")
        if densify_to is not None and amount == "off" and densify_to <= before["gaussians"]:
            raise QuerySplatError(
                f"--densify {densify_to}: the scene has {before['gaussians']:,} Gaussians already",
                "Ask for more, or use --prune N for fewer.",
            )
        gaussians = read_ply(ply_path(path)) if apart else None
    with stages("tto") as progress:
        if scene.anchors is None:
            plan = plan_release(RELEASE_STEPS if steps is None else steps, space=chosen, lr=lr)
        else:
            count = before["gaussians"]
            plan = plan_tto(
                steps,
                views=len(scene.views),
                gaussians=count if chosen == "gaussians" else scene.anchors.opacities.numel(),
                staying=target_count(count, amount, scene.cameras),
                space=chosen,
                lr=lr,
                resumed=chosen in spaces,
            )
        start = Start(scene.memories, scene.anchors, gaussians, None if apart else scene.kept)
        photos = scene.views, scene.cameras
        adapted = _optimise(
            model, start, photos, plan, seed, amount, progress, densify_to=densify_to, refine_cameras=refine_cameras
        )
        heldout = scene.heldout and (
            scene.heldout[0],
            with_refined_focal(scene.heldout[1], scene.cameras, adapted.cameras),
        )
    with stages("score"):
        quality = {
            "input": quality_entry(score(adapted.gaussians, scene.views, adapted.cameras)),
            "heldout": quality_entry(score(adapted.gaussians, *heldout)) if heldout else None,
        }
    with stages("write"):
        report = replace(
            Report.from_dict(before),
            gaussians=len(adapted.gaussians),
            seconds=seconds_entry(stages.seconds),
            quality=quality,
            left_out=omissions.taken_further(before["left_out"], adapted),
            tto=[*before["tto"], *tto_entries(adapted.runs)],
            peak_memory_gib=round(peak_gib(), 2),
            machine=machine(),
        )
        stored = replace(scene, cameras=adapted.cameras, heldout=heldout, memories=adapted.memories, kept=adapted.kept)
        write_scene(ply_path(path), stored, adapted.gaussians, report.as_dict())
    return report


def load_again(name: str, settings: dict[str, Any], weights: Path | None, device: torch.device) -> QuerySplat:
    """The model of a stored scene, from the settings in its report."""
    stored = settings.get("weights")
    folder = weights or (Path(stored) if stored else None)
    model = load(name, folder, precision=check_precision(settings.get("precision", "fp32")), device=device)
    if model.config.queries == "learned" and settings["queries"]:
        model.keep_queries(settings["queries"])
    return model


def _optimise(
    model: QuerySplat,
    start: Start,
    photos: tuple[Views, Cameras],
    plan: Sequence[TtoRun],
    seed: int,
    amount: Amount,
    progress: Progress,
    *,
    densify_to: int | None = None,
    refine_cameras: bool = False,
    everything: bool = False,
) -> Adapted:
    """The result on the CPU, however it was made: on the device of `model`.

    `amount` is that of the Gaussians that stay, and SH bands that change nothing go; with `everything` all stay, and
    of official models, which give what the release gives, unless a number is asked for.
    """
    everything = everything or start.anchors is None
    if everything and amount == "auto":
        amount = "off"
    device = next(model.parameters()).device
    target = RenderingLoss(*to_device(photos, device))
    tested = evenly_spaced(range(len(target.views)), TESTED_VIEWS)
    total = sum(run.settings.steps for run in plan)
    taken = 0

    def show(step: TtoStep) -> None:
        nonlocal taken
        taken += 1
        progress(f"loss {step.loss:.4f}, {step.psnr:.2f} dB, {step.gaussians:,} Gaussians", taken / total)

    adapted = adapt(
        model,
        to_device(start, device),
        target,
        plan,
        generator=torch.Generator().manual_seed(seed),
        progress=show,
        pruning=None if amount == "off" else partial(_pruned, amount, tested),
        at_once=amount != "auto",
        densify_to=densify_to,
        refine_cameras=refine_cameras,
    )
    if not everything:
        last = replace(target, cameras=adapted.cameras)
        fewer, idle = without_idle_bands(adapted.gaussians, lambda some: last.psnr(some, tested))
        adapted = replace(adapted, gaussians=fewer, idle_bands=idle)
    return to_device(adapted, torch.device("cpu"))


def _score_heldout(scene: BuiltScene, cameras: CameraPass) -> Quality | None:
    heldout = scene.heldout(cameras)
    return score(scene.adapted.gaussians, *heldout) if heldout else None


def _pruned(
    amount: Literal["auto"] | int, tested: list[int], gaussians: Gaussians, target: RenderingLoss, steps_left: float
) -> Pruned:
    return prune(gaussians, target.cameras, amount, lambda some: target.psnr(some, tested), steps_left)


def _savings(settings: ReconstructSettings, scene: BuiltScene, finest: Blurred | None) -> list[omissions.Omission]:
    found = [omissions.LPIPS, *omissions.of_adapted(scene.adapted)]
    if scene.prepared.anchor_report and not settings.keep_everything:
        found.append(omissions.queries(scene.prepared.anchor_report, scene.adapted))
    if scene.geometry.depth is None:
        found.append(omissions.DEPTH)
    if finest:
        found.append(omissions.resolution(finest))
    if settings.poses:
        found.append(omissions.sfm(settings.poses))
    if not scene.time_for_more:
        found.append(omissions.SECOND_SCORE)
    return found
