"""What work costs, and that work which rows share is done once and counts for each."""

import time
from typing import Any

import numpy as np
import pytest
import torch

from querysplat_cli.encoders.base import Geometry, PosedViews
from querysplat_cli.evaluation.costs import measured
from querysplat_cli.evaluation.memoised import MemoisedEncoder
from querysplat_cli.runtime.device import reset_peak_memory
from querysplat_cli.runtime.errors import ImpossibleScene
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.views import Views

MIB = 1 << 20


def test_a_peak_is_that_of_the_work_alone() -> None:
    if not reset_peak_memory():
        pytest.skip("this system lets no process forget its peak (not Linux, or /proc is read-only)")
    big = measured(lambda: float(np.ones(400 * MIB // 8).sum()))[1]
    small = measured(lambda: float(np.ones(MIB // 8).sum()))[1]
    assert big.peak_gib - small.peak_gib == pytest.approx(400 / 1024, abs=0.08)
    assert measured(lambda: time.sleep(0.05))[1].seconds == pytest.approx(0.05, abs=0.04)


class Fake:
    """An encoder that counts what it is asked."""

    name, size, own_frame = "fake", 448, False

    def __init__(self) -> None:
        self.asked: list[str] = []

    def estimate_cameras(self, photos: Any, **options: Any) -> PosedViews:
        self.asked.append("estimate_cameras")
        time.sleep(0.02)
        if options["seed"] == 13:
            raise ImpossibleScene("no overlap")
        views = Views(torch.zeros(1, 3, 4, 4), torch.ones(1, 4, 4, dtype=torch.bool), ("a",), ((4, 4),))
        return PosedViews(views, Cameras(torch.eye(4)[None], torch.eye(3)[None], 4, 4), torch.zeros(0, 3), ())

    def estimate_geometry(self, posed: PosedViews, **options: Any) -> Geometry:
        self.asked.append("estimate_geometry")
        return Geometry(torch.ones(1, 4, 4), torch.ones(1, 4, 4), (), 4)

    def free(self) -> None:
        raise AssertionError("cases to come need it")

    def bytes_needed(self, views: int, size: int) -> int | None:
        return None


def test_a_question_is_asked_once() -> None:
    def silent(text: str, fraction: float) -> None:
        pass

    fake = Fake()
    encoder = MemoisedEncoder(fake)
    options: dict[str, Any] = {"max_size": 64, "progress": silent}
    first = encoder.estimate_cameras([], seed=1, **options)
    assert encoder.estimate_cameras([], seed=1, **options) is first
    assert encoder.cost_of(first).seconds >= 0.02
    other = encoder.estimate_cameras([], seed=1, max_size=32, progress=silent)
    assert other is not first
    depths = [encoder.estimate_geometry(posed, seed=1, progress=silent) for posed in (first, first, other)]
    assert depths[0] is depths[1] is not depths[2]
    for _ in range(2):
        with pytest.raises(ImpossibleScene, match="no overlap"):
            encoder.estimate_cameras([], seed=13, **options)
    assert fake.asked == [
        "estimate_cameras",
        "estimate_cameras",
        "estimate_geometry",
        "estimate_geometry",
        "estimate_cameras",
    ]
