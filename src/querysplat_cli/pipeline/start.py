"""What the optimisation of a scene begins with: views without transients, their colours, and queries of both."""

from dataclasses import dataclass, replace

from querysplat_cli.encoders.base import Geometry, PosedViews
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.pipeline.settings import ReconstructSettings
from querysplat_cli.queries.prepare import PreparedQueries, prepare
from querysplat_cli.queries.transients import find_transients, without
from querysplat_cli.runtime.compiler import SCENE_KERNELS, wait_until_compiled
from querysplat_cli.runtime.progress import Stages
from querysplat_cli.scene.exposures import Exposures
from querysplat_cli.scene.masks import MaskedShare
from querysplat_cli.tto.exposure_fit import PhotoColours, compare_photos
from querysplat_cli.tto.policy import TTO_POLICY


@dataclass(frozen=True)
class SceneStart:
    """Views without transients, and the queries that were made of them.

    transients: how much was left out; None where nothing was, or nothing was looked for.
    colours: how far the views agree in colour; None where that was not measured.
    """

    posed: PosedViews
    queries: PreparedQueries
    transients: MaskedShare | None = None
    colours: PhotoColours | None = None

    @property
    def exposures(self) -> Exposures | None:
        """The colour transforms of views that disagree."""
        return self.colours.needed if self.colours else None


def make_start(
    posed: PosedViews, geometry: Geometry, model: QuerySplat, settings: ReconstructSettings, stages: Stages
) -> SceneStart:
    """Where views disagree in colour, transients and queries are found in their colours without the differences.

    Official models are optimised as in the release, with all pixels and without transforms.
    """
    with stages("queries") as progress:
        wait_until_compiled(*SCENE_KERNELS, progress=progress)
        measured = transients = None
        alike = posed.views
        anchored = model.config.queries == "anchored" and geometry.depth is not None
        seeks = settings.transients == "auto" and not settings.keep_everything
        if anchored and len(posed.views) > 1 and (seeks or settings.exposure == "auto"):
            measured = compare_photos(posed.views, posed.cameras, geometry)
            alike = alike if measured.agree else measured.exposures.removed_from(alike)
        if measured and seeks:
            pixels = find_transients(alike, posed.cameras, geometry)
            counts = {view: int(each.sum()) for view, each in enumerate(pixels) if each.any()}
            transients = MaskedShare.of(counts, alike.sizes)
            if transients:
                posed, alike = replace(posed, views=without(posed.views, pixels)), without(alike, pixels)
        colours = measured if settings.exposure == "auto" else None
        queries = prepare(
            model,
            replace(posed, views=alike) if colours else posed,
            geometry,
            queries=settings.queries,
            soft_query_limit=None if settings.keep_everything or settings.tto == 0 else TTO_POLICY.queries,
            target=settings.tto_target,
            keep_all=settings.keep_everything,
        )
    return SceneStart(posed, queries, transients, colours)
