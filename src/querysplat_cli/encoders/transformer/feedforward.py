"""Learned encoders: one pass of a network finds cameras, features and depth together."""

from collections.abc import Callable, Sequence

import torch

from querysplat_cli.encoders.base import CameraRequest, EncoderOptions, Geometry, PosedViews
from querysplat_cli.encoders.transformer.config import VgmConfig
from querysplat_cli.encoders.transformer.vgm import Vgm, VgmOutput, load_vgm
from querysplat_cli.runtime.errors import ImpossibleScene, QuerySplatError
from querysplat_cli.runtime.progress import Progress
from querysplat_cli.runtime.weight_registry import find_weights
from querysplat_cli.scene.fit import network_views
from querysplat_cli.scene.sim3 import rigid
from querysplat_cli.scene.views import Photo, Views

POINT_SPACING = 16
"""Pixels between the scene points that are taken from a depth map."""


class FeedForwardEncoder:
    """A learned VGM as an encoder.

    Cameras, depth and features are in the frame of the pass that found them: unchanged, or moved so that the first
    camera is the origin (`EncoderOptions.frame`). The last pass is kept, with the views that it was made for.
    """

    own_frame = True

    def __init__(
        self, name: str, make: Callable[[VgmConfig], Vgm], default: VgmConfig, options: EncoderOptions
    ) -> None:
        self.name = name
        self.size = default.pretrained_image
        self._options = options
        path = find_weights(name, options.weights)
        self._model = load_vgm(make, default, path, precision=options.precision, device=options.device)
        self._last: tuple[Views, VgmOutput] | None = None

    @property
    def patch(self) -> int:
        return self._model.config.patch

    def estimate_cameras(self, photos: Sequence[Photo], request: CameraRequest, progress: Progress) -> PosedViews:
        """The cameras that the network predicts, for photos cut or padded to its size.

        Points come from the depth maps, inside the masks; there are none without depth. Raises QuerySplatError for
        known cameras or a size below a patch, and ImpossibleScene when a camera is not finite.
        """
        if request.known is not None:
            raise QuerySplatError(
                f"--poses: {self.name} finds cameras itself and can take none",
                "Leave --poses out, or use another preset.",
            )
        size = request.max_size
        if size < self.patch:
            raise QuerySplatError(f"--max-size {size} is less than a patch of {self.patch}", "Use a larger size.")
        views = network_views(photos, size, self.patch, self._options.fit)
        found = self._predict(views, progress)
        cameras = found.cameras
        if not bool(cameras.w2c.isfinite().all() and cameras.K.isfinite().all()):
            raise ImpossibleScene(
                f"{self.name} finds no finite cameras for these photos", "Use photos that overlap more."
            )
        points, visibility = torch.zeros(0, 3), (torch.zeros(0, dtype=torch.long),) * len(views)
        if found.depth is not None:
            rows, columns = (torch.arange(POINT_SPACING // 2, side, POINT_SPACING) for side in found.depth.shape[1:])
            depth, shown = (each[:, rows[:, None], columns] for each in (found.depth, views.masks))
            points = cameras.unproject(depth, columns + 0.5, rows + 0.5)[shown]
            visibility = torch.arange(len(points)).split(shown.sum((1, 2)).tolist())
        if self._options.frame == "first_view":
            move = rigid(cameras.w2c[0])
            cameras, points = cameras.transformed(move), move.apply(points)
        return PosedViews(views, cameras, points, visibility)

    def estimate_geometry(self, posed: PosedViews, *, seed: int, progress: Progress) -> Geometry:
        """Depth and features of the pass that made `posed.views`. Another `Views` object costs another pass."""
        found = self._predict(posed.views, progress)
        return Geometry(found.depth, found.confidence, found.features, self.patch)

    def free(self) -> None:
        """Release the weights and the last pass."""
        self._model.to("meta")
        self._last = None

    def bytes_needed(self, views: int, size: int) -> int | None:
        """The weights, and what `VgmConfig.working_bytes` estimates."""
        options = self._options
        weights = sum(tensor.nbytes for tensor in self._model.state_dict().values())
        return weights + self._model.config.working_bytes(
            views, size, options.precision == "bf16", mixed=options.mixture is not None, depth=options.depth
        )

    def _predict(self, views: Views, progress: Progress) -> VgmOutput:
        if self._last is None or self._last[0] is not views:
            self._last = None
            found = self._model.predict(
                views.images.to(self._options.device),
                mixture=self._options.mixture,
                depth=self._options.depth,
                progress=lambda fraction: progress("", fraction),
            )
            self._last = views, _maps_on_cpu(found)
        return self._last[1]


def _maps_on_cpu(found: VgmOutput) -> VgmOutput:
    """Cameras and maps on the CPU. Features are large and stay on the device, where the model reads them."""
    depth, confidence = (each if each is None else each.cpu() for each in (found.depth, found.confidence))
    return VgmOutput(found.cameras.to("cpu"), found.features, depth, confidence)
