"""What is no picture, padding or masked, says nothing about depth. Scenes are those of test_depth.py."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from synthetic import camera, photograph
from test_depth import FOCAL, SIDEWAYS, SIZE, SLANTED, TWO_LAYERS, posed, seen_depth, sparse_points, true_depth

from querysplat_cli.encoders.base import PosedViews
from querysplat_cli.scene.undistort import undistorted


@pytest.mark.parametrize(("planes", "near", "guessed"), [(SLANTED, 0.02, 0.2), (TWO_LAYERS, 0.06, 0.2)])
def test_a_masked_place_leaves_the_depth_around_it_as_it_is(planes: list, near: float, guessed: float) -> None:
    """A logo covers the same pixels of all photos. Windows that saw it matched it with itself: errors of 0.19, 0.37."""
    scene, truth = posed(planes, SIDEWAYS)
    shown = np.ones(SIZE, bool)
    shown[50:90, 70:120] = False
    views, mask = scene.views, torch.from_numpy(shown)
    found = seen_depth(replace(scene, views=replace(views, images=views.images * mask, masks=views.masks & mask)))
    distance = cv2.distanceTransform(shown.astype(np.uint8), cv2.DIST_L2, 5)
    around = np.broadcast_to((distance > 0) & (distance < 6), truth.shape)
    assert np.abs(found.depth.numpy() / truth - 1)[around].mean() < near
    assert (found.confidence.numpy()[around] < 0.25).mean() < guessed


@pytest.mark.parametrize("planes", [SLANTED, TWO_LAYERS])
@pytest.mark.parametrize("shapes", [((144, 192), (192, 144)), ((136, 181), (136, 181))])
def test_padding_moves_no_guess(planes: list, shapes: tuple[tuple[int, int], ...]) -> None:
    """Pictures of which none fills the canvas. 13 to 50 % of the guesses were wrong by more than a tenth."""
    scene, truth = padded(planes, (*shapes, *shapes))
    found = seen_depth(scene)
    errors, guessed = [], []
    for depth, sure, true in zip(found.depth.numpy(), found.confidence.numpy(), truth, strict=True):
        height, width = true.shape
        known = np.isfinite(true)
        errors.append(np.abs(depth[:height, :width] / true - 1)[known])
        guessed.append(sure[:height, :width][known] < 0.25)
    wrong = np.concatenate(errors)[np.concatenate(guessed)] > 0.1
    assert wrong.mean() < 0.08
    assert np.concatenate(errors).mean() < 0.02


def padded(planes: list, shapes: tuple[tuple[int, int], ...]) -> tuple[PosedViews, list[np.ndarray]]:
    """Photos of these (height, width) from `SIDEWAYS`, every 12th pixel of the first as a sparse point; true depths."""
    taken_by = [
        camera(place, (0, 0, 1000.0), size=shape, focal=FOCAL) for place, shape in zip(SIDEWAYS, shapes, strict=True)
    ]
    photos = [photograph(planes, each, f"{i}.png") for i, each in enumerate(taken_by)]
    truth = [true_depth(planes, each) for each in taken_by]
    views, cameras = undistorted(photos, taken_by, max_size=400)
    cloud = sparse_points(taken_by[0], truth[0])
    return PosedViews(views, cameras, cloud, tuple(torch.arange(len(cloud)) for _ in shapes)), truth
