"""An encoder whose answers several rows share, without sharing what they cost."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from querysplat_cli.encoders.base import Encoder, Geometry, PosedViews
from querysplat_cli.evaluation.costs import Cost, measured
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.progress import Progress
from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.views import Photo


class MemoisedEncoder:
    """An encoder that answers what it was asked before at once, and knows what each answer cost."""

    def __init__(self, encoder: Encoder) -> None:
        self.name, self.size, self.own_frame = encoder.name, encoder.size, encoder.own_frame
        self._encoder = encoder
        self._answers: dict[Any, Any] = {}
        self._costs: dict[int, Cost] = {}

    def estimate_cameras(
        self,
        photos: Sequence[Photo],
        *,
        max_size: int,
        seed: int,
        progress: Progress,
        known: Mapping[str, PhotoCamera] | None = None,
    ) -> PosedViews:
        key = ("estimate_cameras", tuple(photo.name for photo in photos), max_size, seed, known is not None)
        return self._once(
            key,
            lambda: self._encoder.estimate_cameras(
                photos, max_size=max_size, seed=seed, progress=progress, known=known
            ),
        )

    def estimate_geometry(self, posed: PosedViews, *, seed: int, progress: Progress) -> Geometry:
        return self._once(
            ("estimate_geometry", id(posed), seed),
            lambda: self._encoder.estimate_geometry(posed, seed=seed, progress=progress),
        )

    def free(self) -> None:
        """Nothing: the next case asks again."""

    def bytes_needed(self, views: int, size: int) -> int | None:
        return self._encoder.bytes_needed(views, size)

    def cost_of(self, answer: PosedViews | Geometry) -> Cost:
        """What it cost to find an answer of this encoder."""
        return self._costs[id(answer)]

    def _once(self, key: Any, ask: Callable[[], Any]) -> Any:
        if key not in self._answers:
            try:
                answer, cost = measured(ask)
            except QuerySplatError as error:
                self._answers[key] = error
            else:
                self._answers[key], self._costs[id(answer)] = answer, cost
        answer = self._answers[key]
        if isinstance(answer, QuerySplatError):
            raise answer
        return answer
