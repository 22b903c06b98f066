"""Costs of a piece of work. Work that several rows share is done once and counts for each row."""

import time
from typing import Any

import numpy as np
import pytest
import torch

from querysplat_cli.encoders.base import CameraRequest, Geometry, PosedViews
from querysplat_cli.evaluation.costs import measured
from querysplat_cli.evaluation.memoised import MemoisedEncoder
from querysplat_cli.runtime.device import reset_peak_memory
from querysplat_cli.runtime.errors import ImpossibleScene
from querysplat_cli.runtime.progress import silent
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.views import Views

MIB = 1 << 20


def test_a_peak_is_that_of_the_work_alone() -> None:
    if not reset_peak_memory():
        pytest.skip("this system cannot reset the peak memory of a process (not Linux, or /proc is read-only)")
    big = measured(lambda: float(np.ones(400 * MIB // 8).sum()))[1]
    small = measured(lambda: float(np.ones(MIB // 8).sum()))[1]
    assert big.peak_gib - small.peak_gib == pytest.approx(400 / 1024, abs=0.08)
    assert measured(lambda: time.sleep(0.05))[1].seconds == pytest.approx(0.05, abs=0.04)


class Fake:
    """An encoder that records its calls."""

    name, size, own_frame = "fake", 448, False

    def __init__(self) -> None:
        self.calls: list[str] = []

    def estimate_cameras(self, photos: Any, request: CameraRequest, progress: Any) -> PosedViews:
        self.calls.append("estimate_cameras")
        time.sleep(0.02)
        if request.seed == 13:
            raise ImpossibleScene("no overlap")
        views = Views(torch.zeros(1, 3, 4, 4), torch.ones(1, 4, 4, dtype=torch.bool), ("a",), ((4, 4),))
        return PosedViews(views, Cameras(torch.eye(4)[None], torch.eye(3)[None], 4, 4), torch.zeros(0, 3), ())

    def estimate_geometry(self, posed: PosedViews, **options: Any) -> Geometry:
        self.calls.append("estimate_geometry")
        return Geometry(torch.ones(1, 4, 4), torch.ones(1, 4, 4), (), 4)

    def free(self) -> None:
        raise AssertionError("later cases need it")

    def bytes_needed(self, views: int, size: int) -> int | None:
        return None


def test_each_result_is_computed_once() -> None:
    fake = Fake()
    encoder = MemoisedEncoder(fake)
    first = encoder.estimate_cameras([], CameraRequest(64, 1), silent)
    assert encoder.estimate_cameras([], CameraRequest(64, 1), silent) is first
    assert encoder.cost_of(first).seconds >= 0.02
    other = encoder.estimate_cameras([], CameraRequest(32, 1), silent)
    assert other is not first
    depths = [encoder.estimate_geometry(posed, seed=1, progress=silent) for posed in (first, first, other)]
    assert depths[0] is depths[1] is not depths[2]
    for _ in range(2):
        with pytest.raises(ImpossibleScene, match="no overlap"):
            encoder.estimate_cameras([], CameraRequest(64, 13), silent)
    assert fake.calls == [
        "estimate_cameras",
        "estimate_cameras",
        "estimate_geometry",
        "estimate_geometry",
        "estimate_cameras",
    ]


def test_an_object_that_died_gives_its_answer_to_no_other() -> None:
    """Python gives the id of an object that was freed to the next one: here, views of another scene."""

    class Scaled(Fake):
        def estimate_geometry(self, posed: PosedViews, **options: Any) -> Geometry:
            return Geometry(posed.points[0, 0].expand(1, 4, 4), None, (), 4)

    encoder = MemoisedEncoder(Scaled())
    views = Views(torch.zeros(1, 3, 4, 4), torch.ones(1, 4, 4, dtype=torch.bool), ("a",), ((4, 4),))
    cameras = Cameras(torch.eye(4)[None], torch.eye(3)[None], 4, 4)
    for i in range(20):
        posed = PosedViews(views, cameras, torch.full((1, 3), float(i)), (torch.tensor([0]),))
        geometry = encoder.estimate_geometry(posed, seed=1, progress=lambda text, fraction: None)
        del posed
        assert geometry.depth is not None
        assert float(geometry.depth[0, 0, 0]) == i
