"""Depth by wide windows, where no narrow one finds the same picture in two photos."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from synthetic import Plane, texture
from test_depth import SIDEWAYS, TWO_LAYERS, posed, seen_depth

from querysplat_cli.encoders.base import PosedViews
from querysplat_cli.encoders.classical import depth as classical_depth
from querysplat_cli.encoders.classical.stereo import Measurement

COARSE = cv2.resize(texture(3, 512)[::64, ::64], (512, 512), interpolation=cv2.INTER_CUBIC)
CROWN = Plane((-1.6, -1.2, 3.4), (1.6, 0, 0), (0, 2.4, 0), COARSE)
"""A surface without detail, before a wall."""
TREE = [TWO_LAYERS[0], CROWN]


def rustling(scene: PosedViews, truth: np.ndarray, strength: float) -> PosedViews:
    """The same photos with leaves on what is nearer than the wall: noise that no two photos share."""
    noise = np.random.default_rng(0).normal(0, strength, truth.shape).astype(np.float32) * (truth < 4)
    images = (scene.views.images + torch.from_numpy(noise)[:, None]).clamp(0, 1)
    return replace(scene, views=replace(scene.views, images=images))


def without_wide_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    def nothing(photos: object, sources: object, ranges: object, fine: Measurement) -> Measurement:
        return Measurement(np.zeros_like(fine.inverse), np.zeros_like(fine.confidence))

    monkeypatch.setattr(classical_depth, "measure_wide", nothing)


def wrong_share(scene: PosedViews, truth: np.ndarray) -> float:
    """Share of the crown whose depth is off by more than a tenth, in all views, well inside of it."""
    inside = np.stack([cv2.erode((view < 4).astype(np.uint8), np.ones((15, 15))) for view in truth]) > 0
    inside[:, :, :12] = False
    return float((np.abs(seen_depth(scene).depth.numpy() / truth - 1) > 0.1)[inside].mean())


def test_leaves_that_no_two_photos_show_alike_stand_where_the_tree_stands(monkeypatch: pytest.MonkeyPatch) -> None:
    """The crowns of a wood from above stood behind the ground: they were guesses, and guesses move back."""
    scene, truth = posed(TREE, SIDEWAYS)
    leaves = rustling(scene, truth, 0.2)
    now = wrong_share(leaves, truth)
    without_wide_windows(monkeypatch)
    assert now < 0.15
    assert wrong_share(leaves, truth) > 0.4
