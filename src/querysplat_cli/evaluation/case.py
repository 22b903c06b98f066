"""One case: the inputs become a scene in every way that the table asks for, and the targets judge each."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np
import torch

from querysplat_cli.encoders.base import Encoder, PosedViews
from querysplat_cli.evaluation.baseline import back_project
from querysplat_cli.evaluation.costs import Cost, measured
from querysplat_cli.evaluation.lpips import Lpips
from querysplat_cli.evaluation.memoised import MemoisedEncoder
from querysplat_cli.evaluation.metrics import Scores, compare
from querysplat_cli.evaluation.protocol import Protocol
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.pipeline.reconstruct import build_scene, load_parts
from querysplat_cli.pipeline.settings import ReconstructSettings
from querysplat_cli.runtime.choices import CameraSource
from querysplat_cli.runtime.device import find_device
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.precision import check_precision, matrix_products
from querysplat_cli.runtime.progress import Stages
from querysplat_cli.scene.cameras import Cameras, PhotoCamera, rescaled, same_shape
from querysplat_cli.scene.formats.dataset import Frame, fetch
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.photos import WHOLE, load_photos
from querysplat_cli.scene.sim3 import DegenerateAlignment, Sim3, align_cameras
from querysplat_cli.scene.views import Photo


@dataclass(frozen=True)
class Row:
    """One line of the table. `overrides` are fields of ReconstructSettings; `method` "depth" splats the VGM's depth.

    Cameras are found (`free`) or the dataset's (`posed`). An encoder that can take none finds those of the inputs in
    both, and the dataset's are those of the targets.
    """

    name: str
    method: Literal["querysplat", "depth"]
    cameras: CameraSource
    overrides: tuple[tuple[str, Any], ...] = ()


@dataclass(frozen=True)
class ViewScore:
    """A target that was scored, and the picture that was made of it."""

    frame: Frame
    camera: PhotoCamera | None
    scores: Scores
    picture: torch.Tensor


@dataclass(frozen=True)
class RowResult:
    """What one row made of a case. `costs` by stage; `missing` says for each group's views without a score, why."""

    views: dict[str, list[ViewScore]]
    missing: dict[str, dict[str, str]]
    costs: dict[str, Cost]
    gaussians: int | None
    warnings: tuple[str, ...]


class CaseRunner:
    """The photos of one case. What several rows have in common is worked out once, and counts for each of them.

    `groups` are the frames of the input, interp and extrap views; `known` the dataset's cameras of the shown
    photos, by name; `photos` each photo as it is and as it is shown.
    """

    def __init__(
        self,
        groups: Mapping[str, Sequence[Frame]],
        cameras: Mapping[str, PhotoCamera],
        protocol: Protocol,
        settings: ReconstructSettings,
        lpips: Lpips | None,
    ) -> None:
        """`cameras` are the dataset's, of the whole photos. Raises QuerySplatError when a photo cannot be read."""
        self.groups, self.protocol = groups, protocol
        self._settings, self._lpips = settings, lpips
        frames = list({frame.name: frame for group in groups.values() for frame in group}.values())
        with TemporaryDirectory() as scratch:
            loaded, unread = load_photos(fetch(frames, Path(scratch)), WHOLE)
        if unread:
            raise QuerySplatError(f"{unread[0].name}: {unread[0].why}", "Download the scene again.")
        self.photos = {}
        for frame, photo in zip(frames, loaded, strict=True):
            named = replace(photo, name=frame.name)
            self.photos[frame.name] = named, protocol.shown(named)
        self.known = {
            name: protocol.shown_camera(cameras[name], photo)
            for name, (photo, _) in self.photos.items()
            if name in cameras
        }
        self._encoders: dict[ReconstructSettings, MemoisedEncoder] = {}

    def run(self, row: Row) -> RowResult:
        """The scores of one row. Raises QuerySplatError when no scene can be made."""
        # Every view is scored with the camera that the protocol gives it.
        settings = replace(self._settings, refine_cameras=False, **dict(row.overrides))
        with matrix_products(check_precision(settings.precision)):
            return self._run(row, settings)

    def _run(self, row: Row, settings: ReconstructSettings) -> RowResult:
        key = same_parts(settings)
        model, own = parts(key)
        encoder = self._encoders.setdefault(key, MemoisedEncoder(own))
        if row.cameras == "posed" and not self.known:
            raise QuerySplatError("the dataset has no cameras of these photos", "Leave the posed rows out.")
        known = row.cameras == "posed" and not encoder.own_frame
        posed = self._estimate_cameras(encoder, settings, self._names("input"), poses_known=known)
        gaussians, costs, warnings = self._build(row, model, encoder, posed, settings)
        if row.cameras == "posed":
            result = self.judge(gaussians, joined(self.known, lenses_of(posed)), "the dataset has no camera of it")
        else:
            lenses, why = self._free_targets(encoder, posed, settings)
            result = self.judge(gaussians, lenses, "it has no camera", why)
        costs = {"cameras": encoder.cost_of(posed), **costs}
        return replace(result, costs=costs, warnings=(*posed.warnings, *warnings))

    def judge(
        self,
        gaussians: Gaussians,
        lenses: Mapping[str, PhotoCamera],
        otherwise: str,
        why: Mapping[str, str] | None = None,
    ) -> RowResult:
        """Scores of a scene's renders with `lenses`, cameras of the shown photos at any size in the scene's frame.

        A view without one is missing, for the reason in `why` or else `otherwise`.
        """
        for name, lens in lenses.items():
            height, width = _size(self.photos[name][1])
            if not same_shape((lens.height, lens.width), (height, width)):
                raise QuerySplatError(
                    f"the encoder saw only {lens.width} × {lens.height} of {name}, shown as {width} × {height}",
                    "Use --protocol release, which shows squares.",
                )
        cameras = {name: rescaled(lens, *_size(self.photos[name][1])) for name, lens in lenses.items()}

        def picture(group: str, frame: Frame) -> torch.Tensor | None:
            if frame.name not in cameras:
                return None
            return self.protocol.picture(gaussians, cameras[frame.name], self.photos[frame.name][0])

        return replace(self.judge_pictures(picture, otherwise, why, cameras), gaussians=len(gaussians))

    def judge_pictures(
        self,
        picture: Callable[[str, Frame], torch.Tensor | None],
        otherwise: str,
        why: Mapping[str, str] | None = None,
        cameras: Mapping[str, PhotoCamera] | None = None,
    ) -> RowResult:
        """Scores of `picture(group, frame)`, which is None where there is none."""
        views: dict[str, list[ViewScore]] = {group: [] for group in self.groups}
        missing: dict[str, dict[str, str]] = {group: {} for group in self.groups}
        for group, frames in self.groups.items():
            for frame in frames:
                image = picture(group, frame)
                if image is None:
                    missing[group][frame.name] = (why or {}).get(frame.name, otherwise)
                    continue
                scores = compare(image, self.truth(frame), self._lpips)
                views[group].append(ViewScore(frame, (cameras or {}).get(frame.name), scores, image))
        return RowResult(views, missing, {}, None, ())

    def truth(self, frame: Frame) -> torch.Tensor:
        return self.protocol.truth(self.photos[frame.name][0])

    def _build(
        self,
        row: Row,
        model: QuerySplat,
        encoder: MemoisedEncoder,
        posed: PosedViews,
        settings: ReconstructSettings,
    ) -> tuple[Gaussians, dict[str, Cost], tuple[str, ...]]:
        if row.method == "depth":
            geometry = encoder.estimate_geometry(posed, seed=settings.seed, progress=_silent)
            depth = geometry.depth
            if depth is None:
                raise QuerySplatError("the encoder was not asked for depth", "This row needs it.")
            gaussians, cost = measured(lambda: back_project(posed.views, posed.cameras, depth))
            return gaussians, {"depth": encoder.cost_of(geometry), "splat": cost}, geometry.warnings
        stages = Stages()
        scene, cost = measured(lambda: build_scene(posed, encoder, model, settings, stages))
        costs = {stage: Cost(spent, cost.peak_gib) for stage, spent in stages.seconds.items()}
        # The stage was nearly free when an earlier row had asked the same.
        geometry = encoder.estimate_geometry(posed, seed=settings.seed, progress=_silent)
        if scene.adapted.interrupted:
            raise KeyboardInterrupt
        return scene.adapted.gaussians, costs | {"depth": encoder.cost_of(geometry)}, geometry.warnings

    def _free_targets(
        self, encoder: MemoisedEncoder, posed: PosedViews, settings: ReconstructSettings
    ) -> tuple[dict[str, PhotoCamera], dict[str, str]]:
        """Cameras of all views in the scene's frame, and why some have none.

        Targets are located together with the inputs (`release`: each group by itself), and come to the scene by the
        similarity of the inputs' cameras. The inputs keep those that the scene was made with.
        """
        inputs, input_names = lenses_of(posed), self._names("input")
        lenses = dict(inputs)
        why: dict[str, str] = {}
        targets = [self._names(group) - input_names for group in self.groups if group != "input"]
        for names in targets if self.protocol.name == "release" else [set().union(*targets)]:
            if not names:
                continue
            try:
                everything = lenses_of(
                    self._estimate_cameras(encoder, settings, input_names | names, poses_known=False)
                )
                moved = joined(everything, inputs)
            except QuerySplatError as error:
                why |= dict.fromkeys(names, error.message)
                continue
            lenses |= {name: moved[name] for name in names & moved.keys()}
        return lenses, why

    def _estimate_cameras(
        self, encoder: MemoisedEncoder, settings: ReconstructSettings, names: set[str], *, poses_known: bool
    ) -> PosedViews:
        known = {name: camera for name, camera in self.known.items() if name in names} if poses_known else None
        photos = [shown for name, (_, shown) in self.photos.items() if name in names]
        # No smaller than the protocol shows them, and no smaller than suits the encoder.
        size = settings.max_size or max(encoder.size, *(max(_size(photo)) for photo in photos))
        return encoder.estimate_cameras(photos, max_size=size, seed=settings.seed, progress=_silent, known=known)

    def _names(self, group: str) -> set[str]:
        return {frame.name for frame in self.groups[group]}


@lru_cache(maxsize=1)
def parts(settings: ReconstructSettings) -> tuple[QuerySplat, Encoder]:
    """Model and encoder for settings as `same_parts` gives them; those asked for last are kept."""
    return load_parts(settings, find_device(settings.device))


def same_parts(settings: ReconstructSettings) -> ReconstructSettings:
    """The same for all settings that need the same model and encoder."""
    return replace(settings, tto=None, tto_target="kv", max_size=None, max_views=None)


def lenses_of(posed: PosedViews) -> dict[str, PhotoCamera]:
    """Each view's camera with its lens, for the photo as it was taken."""
    views, cameras = posed.views, posed.cameras
    lenses = posed.photo_cameras or map(_pinhole, cameras.w2c.double(), cameras.K.double(), views.masks)
    return dict(zip(views.names, lenses, strict=True))


def _pinhole(w2c: torch.Tensor, K: torch.Tensor, mask: torch.Tensor) -> PhotoCamera:
    """The camera of a photo that lies where `mask` is True."""
    rows, columns = (mask.any(axis).nonzero()[:, 0].tolist() for axis in (1, 0))
    cut = K.numpy() - np.array([[0, 0, columns[0]], [0, 0, rows[0]], [0, 0, 0]])
    return PhotoCamera.pinhole(w2c.numpy(), cut, rows[-1] + 1 - rows[0], columns[-1] + 1 - columns[0])


def joined(everything: Mapping[str, PhotoCamera], inputs: Mapping[str, PhotoCamera]) -> dict[str, PhotoCamera]:
    """`everything` in the frame of `inputs`, by the similarity of the cameras that both have."""
    shared = [name for name in inputs if name in everything]
    if len(shared) < 2:
        raise DegenerateAlignment("fewer than two inputs have cameras together with the targets")
    theirs, ours = (torch.stack([torch.from_numpy(of[name].w2c) for name in shared]) for of in (everything, inputs))
    similarity = align_cameras(theirs, ours)
    return {name: _moved(camera, similarity) for name, camera in everything.items()}


def _size(photo: Photo) -> tuple[int, int]:
    return photo.height, photo.width


def _moved(camera: PhotoCamera, similarity: Sim3) -> PhotoCamera:
    alone = Cameras(torch.from_numpy(camera.w2c)[None], torch.eye(3)[None], 1, 1)
    return replace(camera, w2c=alone.transformed(similarity).w2c[0].numpy())


def _silent(text: str, fraction: float) -> None:
    pass
