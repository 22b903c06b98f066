"""`reconstruct`: photos in, a scene out."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace

import torch

from querysplat_cli.encoders.base import CameraRequest, Encoder, PosedViews
from querysplat_cli.encoders.holdout import HoldoutCameras, estimate_holdout_cameras
from querysplat_cli.encoders.registry import ENCODERS
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.pipeline.budget import Budget, working_size
from querysplat_cli.pipeline.build import Allowance, BuiltScene, encode_and_build
from querysplat_cli.pipeline.distinct import duplicates
from querysplat_cli.pipeline.first_sight import first_sight
from querysplat_cli.pipeline.gaussian_files import check_target, folder_of_scene
from querysplat_cli.pipeline.given_depth import photos_with_depth
from querysplat_cli.pipeline.given_frame import given_frame, rounding_warnings
from querysplat_cli.pipeline.memory import MemoryNeeds, within_memory
from querysplat_cli.pipeline.metric import check_scale, in_metres, in_metres_of_depth, metres_of
from querysplat_cli.pipeline.omitted import omissions_of
from querysplat_cli.pipeline.parts import load_parts, with_absolute_parts
from querysplat_cli.pipeline.perceptual import optimisation_lpips
from querysplat_cli.pipeline.policy import PIPELINE_POLICY
from querysplat_cli.pipeline.regions.build import build_regions, check_regions, region_count
from querysplat_cli.pipeline.scene_folder import SCENE_FOLDER, StoredScene, check_picture_names, write_scene
from querysplat_cli.pipeline.scene_points import scene_points
from querysplat_cli.pipeline.scene_scores import SceneScores, heldout_photos, score_scene
from querysplat_cli.pipeline.settings import ReconstructSettings
from querysplat_cli.pipeline.unfinished import Unfinished, check_name, is_long, unfinished
from querysplat_cli.prune.resolution import Blurred, blurred
from querysplat_cli.reporting.colourless import colourless_warning
from querysplat_cli.reporting.report import (
    Report,
    exposure_entry,
    heldout_entry,
    machine,
    matching_entry,
    quality_entry,
    seconds_entry,
    settings_entry,
    tto_entries,
    views_entry,
)
from querysplat_cli.runtime.cluster import find_engine
from querysplat_cli.runtime.compiler import SCENE_KERNELS, start_compiling
from querysplat_cli.runtime.device import find_device, free_bytes, peak_gib
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.lengths import BY_DEPTH
from querysplat_cli.runtime.precision import check_precision, matrix_products
from querysplat_cli.runtime.progress import Stages
from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.drafts import claimed
from querysplat_cli.scene.filed_pixels import FiledPixels
from querysplat_cli.scene.files import refuse_existing, refuse_replacing, without_steps, writable
from querysplat_cli.scene.formats.known import read_known_cameras
from querysplat_cli.scene.inputs import load_inputs
from querysplat_cli.scene.lenses import pinhole_photos
from querysplat_cli.scene.masks import MaskedShare
from querysplat_cli.scene.match_cameras import cameras_of_photos
from querysplat_cli.scene.overlays import without_overlays
from querysplat_cli.scene.photos import find_photos, unread_folders
from querysplat_cli.scene.views import LeftOut, Photo, PhotoSource, forget_pixels


@dataclass(frozen=True)
class _Inputs:
    """Photos, networks, and how large the working pictures are (longer side, pixels)."""

    photos: list[Photo]
    left_out: tuple[LeftOut, ...]
    overlaid: MaskedShare | None
    model: QuerySplat
    encoder: Encoder
    known: Mapping[str, PhotoCamera] | None
    budget: Budget | None
    size: int
    finest: Blurred | None
    bytes_expected: int | None

    @property
    def sources(self) -> dict[str, PhotoSource]:
        """Where the photos come from, by name."""
        return {photo.name: photo.source for photo in self.photos}


def reconstruct(settings: ReconstructSettings, stages: Stages | None = None) -> Report:
    """Make a scene of photos: `settings.ply` and the scene folder beside it.

    Raises QuerySplatError on bad input and ImpossibleScene when no scene can be made of the photos; nothing is written
    then.
    """
    check_target(settings.ply)
    outputs = [settings.ply, folder_of_scene(settings.ply)]
    if settings.encoder:
        ENCODERS.check(settings.encoder)
    refuse_replacing([*settings.inputs, *([settings.poses] if settings.poses else [])], outputs)
    refuse_existing(outputs[:1], force=settings.force)
    refuse_existing(outputs[1:], force=settings.force, kind=SCENE_FOLDER)
    device = find_device(settings.device)
    place, products = without_steps(outputs[1]), matrix_products(check_precision(settings.precision))
    with writable(settings.ply.parent), claimed(place), products:
        return _reconstruct(with_absolute_parts(settings), device, stages or Stages())


def _reconstruct(settings: ReconstructSettings, device: torch.device, stages: Stages) -> Report:
    check_name(settings)
    inputs = _read_inputs(settings, device, stages)
    check_regions(settings, len(inputs.photos), inputs.encoder)
    check_picture_names(settings.ply.parent, inputs.photos)
    check_scale(settings.metres_by, inputs.photos, poses_known=inputs.known is not None)
    if not is_long(settings, len(inputs.photos)):
        return _made(inputs, settings, stages, None)
    with unfinished(settings, inputs.photos, inputs.size) as work:
        return _made(inputs, settings, stages, work)


def _made(inputs: _Inputs, settings: ReconstructSettings, stages: Stages, work: Unfinished | None) -> Report:
    def find() -> HoldoutCameras:
        return _find_cameras(inputs, settings, stages)

    passes = work.cameras(find) if work else find()
    if settings.asks_large and passes.split.inputs.photo_cameras is None:
        raise QuerySplatError(
            f"--quality {settings.quality}: this encoder cuts the photos, and large ones would not fit its cameras",
            "Use --encoder classical, or --quality standard.",
        )
    metres = metres_of(settings.metres_by, passes.split.inputs, inputs.photos)
    forget_pixels(inputs.photos)
    posed = passes.split.inputs
    distinct = len(posed.views) - len(duplicates(posed, keep_all=settings.keep_everything))
    count = region_count(settings, distinct, inputs.encoder)
    if settings.cluster and count == 1:
        stages.say("--cluster is not used: there is one region")
    built = None
    if work and count > 1:
        passes = replace(passes, split=work.put_away(passes.split))
        posed, engine = passes.split.inputs, find_engine(settings.cluster, say=stages.say)
        built = build_regions(posed, count, settings, inputs.sources, work, engine, stages)
        scene = built.scene
    else:
        allowance = Allowance(inputs.budget, inputs.sources)
        scene = encode_and_build(posed, inputs.encoder, inputs.model, settings, stages, allowance)
    scores = score_scene(scene, passes.split, inputs.sources, stages)
    with stages("write"):
        report = _report(inputs, passes, scene, scores, settings, stages)
        report = replace(report, resumed=list(work.notes) if work else [])
        report = built.added_to(report, scores.inputs) if built else report
        stored = _stored(inputs, passes, scene, settings)
        if metres:
            stored, report = in_metres(stored, report, metres)
        elif settings.metres_by == BY_DEPTH:
            stored, report = in_metres_of_depth(stored, report, scene.geometry.depth_maps)
        entries = report.as_dict()
        write_scene(settings.ply, stored, scene.gaussians, entries)
    return Report.from_dict(entries)


def _read_inputs(settings: ReconstructSettings, device: torch.device, stages: Stages) -> _Inputs:
    free = free_bytes(device)
    with stages("photos") as progress:
        keep = FiledPixels(without_steps(settings.ply).parent, PIPELINE_POLICY.pixel_bytes)
        paths = find_photos(settings.inputs)
        photos, unread = load_inputs(paths, settings.film_frames, progress=progress, keep=keep)
        folders = [*settings.inputs, *([settings.depth_maps] if settings.depth_maps else [])]
        unread = [*unread_folders(folders), *unread]
        keeps = settings.overlays == "off" or settings.keep_everything
        photos, overlaid = (photos, None) if keeps else without_overlays(photos)
    if device.type == "cpu":
        start_compiling(*SCENE_KERNELS)
    with stages("model") as progress:
        model, encoder = load_parts(settings, device)
        optimisation_lpips(settings.lpips, official=model.config.queries == "learned")  # a damaged file ends it here
        given = read_known_cameras(settings.poses, fisheye=True, photos=paths) if settings.poses else None
        known = cameras_of_photos(photos, given) if given else None
        photos, known = pinhole_photos(photos, known, settings.lens, keep)
        photos = photos_with_depth(photos, settings, known, encoder.name)
        budget = Budget(settings.budget, stages.elapsed) if settings.budget else None
        size = settings.max_size or encoder.size
        adjustable = encoder.name == "classical" and not settings.max_size
        finest = blurred(photos, size) if adjustable and not settings.keep_everything else None
        size = finest.size if finest else size
        if budget and adjustable:
            largest = max(photos, key=lambda photo: photo.height * photo.width)
            twice = settings.holdout_every and settings.holdout_cameras == "isolated" and not known
            used = min(len(photos), settings.max_views or len(photos))
            size = working_size(budget, used, 2 if twice else 1, (largest.height, largest.width), size)
        steps_are_planned = settings.tto is None and model.config.queries == "anchored"
        needs = MemoryNeeds(encoder, model, size, optimising=steps_are_planned or bool(settings.tto))
        photos, too_many, expected = within_memory(photos, needs, free, settings.max_views)
        if expected:
            progress(f"{len(photos)} views will take about {expected / 2**30:.1f} GiB", 1.0)
    return _Inputs(photos, (*unread, *too_many), overlaid, model, encoder, known, budget, size, finest, expected)


def _find_cameras(inputs: _Inputs, settings: ReconstructSettings, stages: Stages) -> HoldoutCameras:
    def estimate_cameras(chosen: Sequence[Photo]) -> PosedViews:
        with stages("cameras") as progress:
            request = CameraRequest(inputs.size, settings.seed, inputs.known)
            return inputs.encoder.estimate_cameras(chosen, request, progress)

    return estimate_holdout_cameras(
        inputs.photos,
        settings.holdout_every,
        settings.holdout_cameras,
        estimate_cameras,
        poses_known=inputs.known is not None,
        own_frame=inputs.encoder.own_frame,
    )


def _report(
    inputs: _Inputs,
    passes: HoldoutCameras,
    scene: BuiltScene,
    scores: SceneScores,
    settings: ReconstructSettings,
    stages: Stages,
) -> Report:
    expected, further = inputs.bytes_expected, scene.full_size
    warnings = [*passes.warnings, *scene.geometry.warnings, *colourless_warning(scene.posed.views)]
    return Report(
        ply=str(settings.ply),
        scene=str(folder_of_scene(settings.ply)),
        views=views_entry(scene.posed.views.names, (*inputs.left_out, *passes.left_out, *scene.duplicates)),
        gaussians=len(scene.gaussians),
        seconds=seconds_entry(stages.seconds, stages.elapsed()),
        quality={
            "input": quality_entry(scores.inputs),
            "heldout": heldout_entry(passes.split.protocol, scores.heldout, passes.difference),
            **({"full_size": scores.large} if scores.large else {}),
        },
        left_out=[asdict(omission) for omission in omissions_of(settings, scene, inputs.finest, inputs.overlaid)],
        warnings=[*warnings, *rounding_warnings(passes.split.inputs, inputs.known, scene.gaussians)],
        tto=[*tto_entries(scene.adapted.runs), *(further.runs if further else [])],
        settings=settings_entry(asdict(settings)),
        peak_memory_gib=round(peak_gib(), 2),
        machine=machine(),
        memory_estimate_gib=expected and round(expected / 2**30, 2),
        full_size=(further.summary or None) if further else None,
        exposure=exposure_entry(scene.colours),
        unseen=scores.unseen.entry() if scores.unseen else None,
        backdrop=len(scene.backdrop) if scene.backdrop else 0,
        matching=matching_entry(passes.split.inputs.matching),
        depth_maps=used.entry() if (used := scene.geometry.depth_maps) else None,
    )


def _stored(inputs: _Inputs, passes: HoldoutCameras, scene: BuiltScene, settings: ReconstructSettings) -> StoredScene:
    heldout = heldout_photos(scene, passes.split, inputs.sources)
    files = [*scene.files, *(heldout.files if heldout else ())]
    return StoredScene(
        scene.posed.views,
        scene.adapted.cameras,
        (heldout.views, heldout.cameras) if heldout else None,
        scene.adapted.memories,
        scene.prepared.anchors,
        settings.preset,
        scene.prepared.map,
        scene.adapted.kept,
        {file.name: file for file in files},
        given_frame(passes.split.inputs, inputs.known)
        or first_sight(scene.gaussians, scene.adapted.cameras, settings.frame),
        len(scene.backdrop) if scene.backdrop else 0,
        scene.exposures,
        scene_points(scene.posed),
    )
