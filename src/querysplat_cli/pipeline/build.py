"""One scene from photos with cameras: near-duplicates left out, depth, queries, optimisation."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import torch

from querysplat_cli.encoders.base import Encoder, Geometry, PosedViews
from querysplat_cli.encoders.holdout import PosedSplit
from querysplat_cli.model.memories import Features
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.pipeline.budget import Budget, OptimisingTime
from querysplat_cli.pipeline.distinct import distinct_views
from querysplat_cli.pipeline.full_size import FullSize, LargePhotos, machine_pace, take_to_full_size
from querysplat_cli.pipeline.given_depth import depth_of_views
from querysplat_cli.pipeline.optimise import optimise_start
from querysplat_cli.pipeline.perceptual import optimisation_lpips
from querysplat_cli.pipeline.policy import PIPELINE_POLICY
from querysplat_cli.pipeline.settings import ReconstructSettings
from querysplat_cli.pipeline.start import SceneStart, make_start
from querysplat_cli.prune.gaussians import target_count
from querysplat_cli.queries.backdrop import shows_background
from querysplat_cli.queries.prepare import PreparedQueries
from querysplat_cli.runtime.progress import Stages
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.exposures import Exposures
from querysplat_cli.scene.gaussians import Gaussians, joined
from querysplat_cli.scene.masks import MaskedShare
from querysplat_cli.scene.photo_files import PhotoFile, photo_files
from querysplat_cli.scene.views import LeftOut, PhotoSource, Views
from querysplat_cli.tto.adapt import Adapted
from querysplat_cli.tto.cameras import refinable, with_refined_focal
from querysplat_cli.tto.exposure_fit import PhotoColours
from querysplat_cli.tto.features import Start
from querysplat_cli.tto.full_size_plan import TimeLimit, plan_full_size
from querysplat_cli.tto.options import OptimiseOptions
from querysplat_cli.tto.plan import TtoRun, automatic_steps, plan_release, plan_tto
from querysplat_cli.tto.policy import TTO_POLICY


@dataclass(frozen=True)
class BuiltScene:
    """A scene and what it was made of.

    posed: the input views that the scene was made from, without transients, and with their cameras before optimisation,
        which may have corrected them.
    adapted: after the runs on the working pictures.
    files: the photos of the input views, where they can be found again.
    full_size: after those on the photos; None where there were none.
    backdrop: Gaussians behind everything (`queries/backdrop.py`); None where there are none.
    duplicates: views that were left out of the scene.
    colours: how far the photos agree in colour; None where that was not measured.
    transients: how much was left out as such; None where there is nothing, or nothing was looked for.
    stopped: whether Ctrl-C came after the runs on the working pictures, before the first step on the photos.
    """

    posed: PosedViews
    geometry: Geometry
    prepared: PreparedQueries
    adapted: Adapted
    files: tuple[PhotoFile, ...] = ()
    full_size: FullSize | None = None
    backdrop: Gaussians | None = None
    duplicates: tuple[LeftOut, ...] = ()
    colours: PhotoColours | None = None
    transients: MaskedShare | None = None
    stopped: bool = False

    @property
    def gaussians(self) -> Gaussians:
        """The scene as it is written; the backdrop comes last."""
        found = self.full_size or self.adapted
        return joined(found.gaussians, self.backdrop) if self.backdrop else found.gaussians

    @property
    def exposures(self) -> Exposures | None:
        """The colour transforms of the input photos; None where they show the scene's own colours."""
        return (self.full_size or self.adapted).exposures

    @property
    def interrupted(self) -> bool:
        return self.stopped or self.adapted.interrupted or bool(self.full_size and self.full_size.interrupted)

    @property
    def inputs(self) -> LargePhotos:
        """The photos that the scene was made from, with their cameras after optimisation."""
        theirs = self.posed.views, self.adapted.cameras, self.files, self.exposures
        return LargePhotos(*theirs, self.prepared.map.confirmed)

    def heldout(self, cameras: PosedSplit) -> tuple[Views, Cameras] | None:
        """The held-out views of the pass that the scene was made from, with cameras corrected as the inputs' were."""
        if cameras.heldout is None:
            return None
        views, theirs = cameras.heldout
        return views, with_refined_focal(theirs, self.posed.cameras, self.adapted.cameras)


@dataclass(frozen=True)
class Allowance:
    """What the making of a scene may use.

    budget: its time; None sets no limit.
    sources: where the photos come from, by name, for an optimisation on larger pictures than the working ones.
    """

    budget: Budget | None = None
    sources: Mapping[str, PhotoSource] = field(default_factory=dict)


def encode_and_build(
    posed: PosedViews,
    encoder: Encoder,
    model: QuerySplat,
    settings: ReconstructSettings,
    stages: Stages,
    allowance: Allowance = Allowance(),
) -> BuiltScene:
    """`encode_and_build_all` without near-duplicate views."""
    posed, duplicates = distinct_views(posed, keep_all=settings.keep_everything)
    scene = encode_and_build_all(posed, encoder, model, settings, stages, allowance)
    return replace(scene, duplicates=duplicates)


def encode_and_build_all(
    posed: PosedViews,
    encoder: Encoder,
    model: QuerySplat,
    settings: ReconstructSettings,
    stages: Stages,
    allowance: Allowance,
) -> BuiltScene:
    """`build_scene` with the geometry that the encoder estimates.

    The encoder is freed then: its weights make room for the decoders.
    """
    with stages("depth") as progress:
        given = replace(posed, depth_maps=depth_of_views(posed, allowance.sources))
        geometry = encoder.estimate_geometry(given, seed=settings.seed, progress=progress)
    encoder.free()
    start = make_start(posed, geometry, model, settings, stages)
    geometry = replace(geometry, features=())  # they are large, and optimisation needs the memory
    return _finished(start, geometry, model, settings, stages, allowance)


def build_scene(
    posed: PosedViews,
    geometry: Geometry,
    model: QuerySplat,
    settings: ReconstructSettings,
    stages: Stages | None = None,
) -> BuiltScene:
    """Queries, memories and test-time optimisation: a scene from given cameras and geometry."""
    stages = stages or Stages()
    start = make_start(posed, geometry, model, settings, stages)
    return _finished(start, replace(geometry, features=()), model, settings, stages, Allowance())


def _finished(
    start: SceneStart,
    geometry: Geometry,
    model: QuerySplat,
    settings: ReconstructSettings,
    stages: Stages,
    allowance: Allowance,
) -> BuiltScene:
    """The scene after its optimisation."""
    posed, prepared, exposures = start.posed, start.queries, start.exposures
    adapted, time = _optimised(posed, prepared, model, settings, stages, allowance.budget, exposures)
    files = photo_files(posed.views.names, posed.photo_cameras, allowance.sources) if allowance.sources else ()
    scene = BuiltScene(posed, geometry, prepared, adapted, files, colours=start.colours, transients=start.transients)
    scene = _taken_further(scene, next(model.parameters()).device, settings, stages, time)
    if not settings.backdrop or prepared.anchors is None or not shows_background(posed.views):
        return scene
    return replace(scene, backdrop=scene.inputs.backdrop(scene.gaussians))


def _optimised(
    posed: PosedViews,
    prepared: PreparedQueries,
    model: QuerySplat,
    settings: ReconstructSettings,
    stages: Stages,
    budget: Budget | None,
    exposures: Exposures | None,
) -> tuple[Adapted, OptimisingTime | None]:
    """The optimised scene, and the time that the budget had for it."""
    with stages("tto") as progress:
        perceptual = optimisation_lpips(settings.lpips, official=prepared.anchors is None)
        options = replace(_options(settings, posed), perceptual=perceptual)
        count = _gaussian_count(prepared, model)
        time = budget.optimising(count) if budget else None
        plan = _plan(prepared, count, posed.cameras, options, time.seconds if time else None)
        optimised = any(run.settings.steps for run in plan)
        variables = prepared.variables.map(torch.Tensor.float) if optimised else prepared.variables
        origin = variables if isinstance(variables, Features) and prepared.anchors is not None else None
        start = Start(variables, prepared.anchors, origin=origin)
        photos = posed.views, posed.cameras
        return optimise_start(model, start, photos, plan, options, progress, exposures), time


def _taken_further(
    scene: BuiltScene,
    device: torch.device,
    settings: ReconstructSettings,
    stages: Stages,
    time: OptimisingTime | None,
) -> BuiltScene:
    """The scene after its optimisation in Gaussian space, where settings and time ask for it."""
    level, seconds = settings.full_size, time.full_size_seconds() if time else None
    if scene.interrupted or level is None or (time and seconds is None):
        return scene
    if scene.prepared.anchors is None and not settings.asks_large:  # as in the release
        return scene
    photos, gaussians = scene.inputs, scene.adapted.gaussians
    most = settings.prune if isinstance(settings.prune, int) else None
    with stages("full size") as progress:
        try:
            limit = TimeLimit(seconds, machine_pace(photos, gaussians, device)) if seconds else None
            plan = plan_full_size(level, photos.summary(), len(gaussians), limit=limit, most=most)
            found = take_to_full_size(photos, gaussians, plan, seed=settings.seed, device=device, progress=progress)
        except KeyboardInterrupt:
            return replace(scene, stopped=True)
    return replace(scene, full_size=found)


def _options(settings: ReconstructSettings, posed: PosedViews) -> OptimiseOptions:
    return OptimiseOptions(
        steps=settings.tto,
        space=settings.tto_space,
        prune="off" if settings.keep_everything else settings.prune,
        refine_cameras=_refines(settings.refine_cameras, posed),
        keep_all=settings.keep_everything,
        seed=settings.seed,
        alone=settings.full_size is None,
    )


def _gaussian_count(prepared: PreparedQueries, model: QuerySplat) -> int:
    if prepared.anchors is None:
        return model.config.query_count * model.config.gaussians_per_query
    return prepared.anchors.opacities.numel()


def _plan(
    prepared: PreparedQueries, count: int, cameras: Cameras, options: OptimiseOptions, seconds: float | None
) -> tuple[TtoRun, ...]:
    space = options.space or "features"
    if prepared.anchors is None:
        return plan_release(options.steps or 0, space=space, seconds=seconds)
    views, target = len(cameras), target_count(count, options.prune, cameras)
    steps = options.steps
    if steps is None:
        planned = TTO_POLICY.work_seconds if options.alone else TTO_POLICY.work_seconds_before
        steps = automatic_steps(views, count, target, space, seconds=planned, alone=options.alone)
    return plan_tto(steps, views=views, gaussians=count, target_count=target, space=space, seconds=seconds)


def _refines(wanted: bool | None, posed: PosedViews) -> bool:
    """Whether cameras are corrected; by default only those that fit the matches badly.

    Refinement makes good cameras follow the errors of the scene: held out, fox loses 0.4 dB.
    """
    if wanted is not None:
        return wanted
    error = posed.epipolar_error_px
    return error is not None and error > PIPELINE_POLICY.refine_above_px and refinable(posed.cameras)
