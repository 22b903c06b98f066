"""One case: each row of the table makes a scene of the inputs, and the targets score it."""

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

from querysplat_cli.encoders.base import CameraRequest, Encoder, PosedViews
from querysplat_cli.evaluation.baseline import back_project
from querysplat_cli.evaluation.cameras import cameras_by_name, to_frame_of
from querysplat_cli.evaluation.costs import Cost, measured
from querysplat_cli.evaluation.judge import Judge, RowResult, shape_of
from querysplat_cli.evaluation.memoised import MemoisedEncoder
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.pipeline.build import encode_and_build
from querysplat_cli.pipeline.parts import load_parts
from querysplat_cli.pipeline.settings import ReconstructSettings
from querysplat_cli.runtime.choices import CameraSource
from querysplat_cli.runtime.device import find_device
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.precision import check_precision, matrix_products
from querysplat_cli.runtime.progress import Stages, silent
from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.gaussians import Gaussians

OF_PARTS = ("preset", "queries", "encoder", "weights", "precision", "device", "fit", "depth", "matcher")
"""The settings that `load_parts` reads."""


@dataclass(frozen=True)
class Row:
    """One line of the table. `overrides` are fields of ReconstructSettings; `method` "depth" splats the VGM's depth.

    `cameras` are estimated by the encoder ("free") or the dataset's ("posed"). An encoder that cannot take known
    cameras estimates those of the inputs in both; then the dataset's cameras are used for the targets only.
    """

    name: str
    method: Literal["querysplat", "depth"]
    cameras: CameraSource
    overrides: tuple[tuple[str, Any], ...] = ()


class CaseRunner:
    """Runs the rows of one case. Rows share the encoder's results, and each row is charged their full cost."""

    def __init__(self, judge: Judge, settings: ReconstructSettings, lpips: Path | None = None) -> None:
        """`lpips` is a folder of weights for the optimisation of official models, whose loss includes LPIPS."""
        self._judge, self._settings, self._lpips = judge, settings, lpips
        self._encoders: dict[ReconstructSettings, MemoisedEncoder] = {}

    def run(self, row: Row) -> RowResult:
        """The scores of one row. Raises QuerySplatError when no scene can be made."""
        # Every view is scored with the camera that the protocol gives it.
        settings = replace(self._settings, refine_cameras=False, **dict(row.overrides))
        with matrix_products(check_precision(settings.precision)):
            return self._run(row, settings)

    def _run(self, row: Row, settings: ReconstructSettings) -> RowResult:
        key = same_parts(settings)
        model, unshared = parts(key)
        if model.config.queries == "learned":
            settings = replace(settings, lpips=self._lpips)
        encoder = self._encoders.setdefault(replace(key, queries=None), MemoisedEncoder(unshared))
        if row.cameras == "posed" and not self._judge.known:
            raise QuerySplatError("the dataset has no cameras of these photos", "Leave the posed rows out.")
        own = self._size(encoder, settings)
        poses_known = row.cameras == "posed" and not encoder.own_frame
        posed = self._estimate_cameras(encoder, settings, self._judge.names("input"), poses_known=poses_known)
        gaussians, costs, warnings = self._build(row, model, encoder, posed, settings)
        if row.cameras == "posed":
            cameras = to_frame_of(cameras_by_name(posed), self._judge.known)
            result = self._judge.score_scene(gaussians, cameras, "the dataset has no camera of it", own_size=own)
        else:
            cameras, why = self._free_targets(encoder, posed, settings)
            result = self._judge.score_scene(gaussians, cameras, "it has no camera", why, own_size=own)
        costs = {"cameras": encoder.cost_of(posed), **costs}
        return replace(result, costs=costs, warnings=(*posed.warnings, *warnings))

    def _build(
        self,
        row: Row,
        model: QuerySplat,
        encoder: MemoisedEncoder,
        posed: PosedViews,
        settings: ReconstructSettings,
    ) -> tuple[Gaussians, dict[str, Cost], tuple[str, ...]]:
        if row.method == "depth":
            geometry = encoder.estimate_geometry(posed, seed=settings.seed, progress=silent)
            depth = geometry.depth
            if depth is None:
                raise QuerySplatError("the encoder was not asked for depth", "This row needs it.")
            gaussians, cost = measured(lambda: back_project(posed.views, posed.cameras, depth))
            return gaussians, {"depth": encoder.cost_of(geometry), "splat": cost}, geometry.warnings
        stages = Stages()
        scene, cost = measured(lambda: encode_and_build(posed, encoder, model, settings, stages))
        costs = {stage: Cost(spent, cost.peak_gib) for stage, spent in stages.seconds.items()}
        # The stage was nearly free when an earlier row had asked the same.
        geometry = encoder.estimate_geometry(scene.posed, seed=settings.seed, progress=silent)
        if scene.interrupted:
            raise KeyboardInterrupt
        return scene.gaussians, costs | {"depth": encoder.cost_of(geometry)}, geometry.warnings

    def _free_targets(
        self, encoder: MemoisedEncoder, posed: PosedViews, settings: ReconstructSettings
    ) -> tuple[dict[str, PhotoCamera], dict[str, str]]:
        """Cameras of all views in the scene's frame, and why some have none.

        Targets are estimated together with the inputs (in the `release` protocol, each group by itself). The
        similarity of the inputs' cameras brings them to the scene's frame. The inputs keep the cameras that the
        scene was made with.
        """
        input_cameras, input_names = cameras_by_name(posed), self._judge.names("input")
        cameras = dict(input_cameras)
        why: dict[str, str] = {}
        targets = [self._judge.names(group) - input_names for group in self._judge.groups if group != "input"]
        for names in targets if self._judge.protocol.name == "release" else [set().union(*targets)]:
            if not names:
                continue
            try:
                together = self._estimate_cameras(encoder, settings, input_names | names, poses_known=False)
                aligned = to_frame_of(input_cameras, cameras_by_name(together))
            except QuerySplatError as error:
                why |= dict.fromkeys(names, error.message)
                continue
            cameras |= {name: aligned[name] for name in names & aligned.keys()}
        return cameras, why

    def _estimate_cameras(
        self, encoder: MemoisedEncoder, settings: ReconstructSettings, names: set[str], *, poses_known: bool
    ) -> PosedViews:
        known = {name: camera for name, camera in self._judge.known.items() if name in names} if poses_known else None
        photos = [shown for name, (_, shown) in self._judge.photos.items() if name in names]
        request = CameraRequest(self._size(encoder, settings), settings.seed, known)
        return encoder.estimate_cameras(photos, request, silent)

    def _size(self, encoder: MemoisedEncoder, settings: ReconstructSettings) -> int:
        """Longer side of the working pictures: no smaller than the protocol shows them, nor than suits the encoder."""
        shown = (max(shape_of(photo)) for _, photo in self._judge.photos.values())
        return settings.max_size or max(encoder.size, *shown)


@lru_cache(maxsize=1)
def parts(settings: ReconstructSettings) -> tuple[QuerySplat, Encoder]:
    """Model and encoder for settings from `same_parts`. Those of the last call stay in memory."""
    return load_parts(settings, find_device(settings.device))


def same_parts(settings: ReconstructSettings) -> ReconstructSettings:
    """Equal for all settings that need the same model and encoder."""
    chosen = {name: getattr(settings, name) for name in OF_PARTS}
    return ReconstructSettings(inputs=(), **chosen)
