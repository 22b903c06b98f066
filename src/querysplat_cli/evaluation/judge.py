"""The photos of one case, and the scores of the pictures that a method makes of them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch

from querysplat_cli.evaluation.costs import Cost
from querysplat_cli.evaluation.fitted import fitted_photo_camera
from querysplat_cli.evaluation.metrics import Meter, Scores
from querysplat_cli.evaluation.overlap import unmatched_targets
from querysplat_cli.evaluation.policy import EVALUATION_POLICY
from querysplat_cli.evaluation.protocol import Protocol
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.cameras import PhotoCamera, rescaled, same_shape
from querysplat_cli.scene.drafts import scratch_folder
from querysplat_cli.scene.formats.dataset import Frame, fetch
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.orientation import upright_camera
from querysplat_cli.scene.photos import WHOLE, load_photos
from querysplat_cli.scene.views import Photo


@dataclass(frozen=True)
class ViewScore:
    """The scores of one view and the picture that was scored; `camera` is None where only the picture is given."""

    frame: Frame
    camera: PhotoCamera | None
    scores: Scores
    picture: torch.Tensor


@dataclass(frozen=True)
class RowResult:
    """The result of one row on one case, by group of views.

    `missing` has the reason for each view without a score, `costs` the cost of each stage. `apart` has the targets that
    have no verified matches with any input, whether they have a score or not. `gaussians` is None where only pictures
    are given.
    """

    views: dict[str, list[ViewScore]]
    missing: dict[str, dict[str, str]]
    apart: dict[str, list[str]]
    costs: dict[str, Cost]
    gaussians: int | None
    warnings: tuple[str, ...]


class Judge:
    """Scores renders of one case against its photos.

    `groups` are the frames of the input, interp and extrap views. `photos` has each photo as it is and as the
    protocol shows it, by name. `known` has the dataset's cameras of the shown photos, by name.
    """

    def __init__(
        self,
        groups: Mapping[str, Sequence[Frame]],
        cameras: Mapping[str, PhotoCamera],
        protocol: Protocol,
        meter: Meter,
        *,
        fitted: bool = False,
    ) -> None:
        """`cameras` are the dataset's, of the whole photos. With `fitted`, targets are scored from fitted cameras, too.

        Raises QuerySplatError when a photo cannot be read.
        """
        self.groups, self.protocol, self._meter, self._fitted = groups, protocol, meter, fitted
        frames = list({frame.name: frame for group in groups.values() for frame in group}.values())
        with scratch_folder() as scratch:
            loaded, unread = load_photos(fetch(frames, scratch), WHOLE)
        if unread:
            raise QuerySplatError(f"{unread[0].name}: {unread[0].why}", "Download the scene again.")
        self.photos: dict[str, tuple[Photo, Photo]] = {}
        for frame, photo in zip(frames, loaded, strict=True):
            named = replace(photo, name=frame.name)
            self.photos[frame.name] = named, protocol.shown(named)
        self.known = {
            name: protocol.shown_camera(upright_camera(cameras[name], photo), photo)
            for name, (photo, _) in self.photos.items()
            if name in cameras
        }

    def names(self, group: str) -> set[str]:
        return {frame.name for frame in self.groups[group]}

    @cached_property
    def apart(self) -> dict[str, list[str]]:
        """By group, the names of the targets that have no verified matches with any input."""
        inputs = self.names("input")
        targets = set().union(*(self.names(group) for group in self.groups)) - inputs
        found = unmatched_targets(*([self.photos[name][1] for name in sorted(names)] for names in (inputs, targets)))
        return {group: [frame.name for frame in frames if frame.name in found] for group, frames in self.groups.items()}

    def truth(self, frame: Frame) -> torch.Tensor:
        """The picture that renders of this frame are compared with."""
        return self.protocol.truth(self.photos[frame.name][0])

    def score_scene(
        self,
        gaussians: Gaussians,
        cameras: Mapping[str, PhotoCamera],
        otherwise: str,
        why: Mapping[str, str] | None = None,
        *,
        own_size: int | None = None,
    ) -> RowResult:
        """Scores of a scene's renders. `cameras` are those of the shown photos at any size, in the scene's frame.

        A view without a camera is missing, with its reason in `why` or else `otherwise`. `own_size` is that of
        `Protocol.picture`. Raises QuerySplatError for a camera of another aspect ratio.
        """
        for name, camera in cameras.items():
            height, width = shape_of(self.photos[name][1])
            if not same_shape((camera.height, camera.width), (height, width)):
                raise QuerySplatError(
                    f"the encoder saw only {camera.width} × {camera.height} of {name}, shown as {width} × {height}",
                    "Use --protocol release, which shows squares.",
                )
        at_shown_size = {name: rescaled(camera, *shape_of(self.photos[name][1])) for name, camera in cameras.items()}

        def picture(group: str, frame: Frame) -> torch.Tensor | None:
            if frame.name not in at_shown_size:
                return None
            return self.protocol.picture(gaussians, at_shown_size[frame.name], self.photos[frame.name][0], own_size)

        result = replace(self.score_pictures(picture, otherwise, why, at_shown_size), gaussians=len(gaussians))
        if not self._fitted:
            return result
        targets = {
            group: [self._with_fitted(gaussians, view, own_size) for view in views]
            for group, views in result.views.items()
            if group != "input"
        }
        return replace(result, views=result.views | targets)

    def _with_fitted(self, gaussians: Gaussians, view: ViewScore, own_size: int | None) -> ViewScore:
        """The view with the scores of a render from the camera that fits its photo best."""
        assert view.camera is not None
        photo, shown = self.photos[view.frame.name]
        size = EVALUATION_POLICY.release_target_side if self.protocol.name == "release" else max(shape_of(shown))
        camera = fitted_photo_camera(gaussians, view.camera, shown, size)
        picture = self.protocol.picture(gaussians, camera, photo, own_size)
        psnr, ssim, lpips = self._meter.plain(picture, self.truth(view.frame))
        scores = replace(view.scores, psnr_fitted=psnr, ssim_fitted=ssim, lpips_fitted=lpips)
        return replace(view, scores=scores)

    def score_pictures(
        self,
        picture: Callable[[str, Frame], torch.Tensor | None],
        otherwise: str,
        why: Mapping[str, str] | None = None,
        cameras: Mapping[str, PhotoCamera] | None = None,
    ) -> RowResult:
        """Scores of `picture(group, frame)`, which is None for a missing view."""
        views: dict[str, list[ViewScore]] = {group: [] for group in self.groups}
        missing: dict[str, dict[str, str]] = {group: {} for group in self.groups}
        for group, frames in self.groups.items():
            for frame in frames:
                image = picture(group, frame)
                if image is None:
                    missing[group][frame.name] = (why or {}).get(frame.name, otherwise)
                    continue
                scores = self._meter.compare(image, self.truth(frame))
                views[group].append(ViewScore(frame, (cameras or {}).get(frame.name), scores, image))
        return RowResult(views, missing, self.apart, {}, None, ())


def shape_of(photo: Photo) -> tuple[int, int]:
    """Height and width in pixels."""
    return photo.height, photo.width
