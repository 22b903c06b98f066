"""An encoder whose results several rows of an evaluation share, each with the cost of finding it."""

from collections.abc import Callable, Sequence
from typing import Any

from querysplat_cli.encoders.base import CameraRequest, Encoder, Geometry, PosedViews
from querysplat_cli.evaluation.costs import Cost, measured
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.progress import Progress
from querysplat_cli.scene.views import Photo


class _Same:
    """A key that is equal for one and the same object.

    It holds the object. Without that, an object could be freed, and a later one could get its `id`.
    """

    def __init__(self, held: object) -> None:
        self._held = held

    def __hash__(self) -> int:
        return id(self._held)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and self._held is other._held


class MemoisedEncoder:
    """An encoder that computes each result once, and measures what that costs.

    It serves the photos of one case: photos of one name are the same photo, and have the same known camera.
    Depth is found once for each `PosedViews` object; an equal copy of one counts as another.
    """

    def __init__(self, encoder: Encoder) -> None:
        self.name, self.size, self.own_frame = encoder.name, encoder.size, encoder.own_frame
        self._encoder = encoder
        self._results: dict[Any, Any] = {}
        self._costs: dict[_Same, Cost] = {}

    def estimate_cameras(self, photos: Sequence[Photo], request: CameraRequest, progress: Progress) -> PosedViews:
        names = tuple(photo.name for photo in photos)
        return self._once(
            ("estimate_cameras", names, request.max_size, request.seed, request.known is not None),
            lambda: self._encoder.estimate_cameras(photos, request, progress),
        )

    def estimate_geometry(self, posed: PosedViews, *, seed: int, progress: Progress) -> Geometry:
        return self._once(
            ("estimate_geometry", _Same(posed), seed),
            lambda: self._encoder.estimate_geometry(posed, seed=seed, progress=progress),
        )

    def free(self) -> None:
        """Nothing is freed: the next case needs the encoder again."""

    def bytes_needed(self, views: int, size: int) -> int | None:
        return self._encoder.bytes_needed(views, size)

    def cost_of(self, result: PosedViews | Geometry) -> Cost:
        """What it cost to find a result of this encoder."""
        return self._costs[_Same(result)]

    def _once(self, key: Any, compute: Callable[[], Any]) -> Any:
        if key not in self._results:
            try:
                result, cost = measured(compute)
            except QuerySplatError as error:
                self._results[key] = error
            else:
                self._results[key], self._costs[_Same(result)] = result, cost
        result = self._results[key]
        if isinstance(result, QuerySplatError):
            raise result
        return result
