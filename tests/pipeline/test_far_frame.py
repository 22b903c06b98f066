"""Scenes in the frame of given cameras."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from stored_scene import a_stored_scene

from querysplat_cli.encoders.base import PosedViews
from querysplat_cli.pipeline.given_frame import rounding_warnings
from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.gaussians import Gaussians


def posed_and_gaussians() -> tuple[PosedViews, Gaussians]:
    scene, gaussians = a_stored_scene()
    nothing = (torch.zeros(0, dtype=torch.long),) * len(scene.views)
    return PosedViews(scene.views, scene.cameras, torch.zeros(0, 3), nothing), gaussians


def given(posed: PosedViews, offset: float) -> dict[str, PhotoCamera]:
    """The cameras of `posed` in a frame whose origin is so far away."""
    found = {}
    for name, w2c in zip(posed.views.names, posed.cameras.w2c.double().numpy(), strict=True):
        moved = np.array(w2c)
        moved[:3, 3] -= moved[:3, :3] @ (offset, -offset, 0.0)
        found[name] = PhotoCamera(moved, (40.0, 41.0), (18.0, 12.0), (0.0, 0.0, 0.0, 0.0), 24, 36)
    return found


@pytest.mark.parametrize("offset", [0.0, 100.0, 1e4])
def test_files_hold_scenes_near_their_origin(offset: float) -> None:
    posed, gaussians = posed_and_gaussians()
    assert rounding_warnings(posed, given(posed, offset), gaussians) == ()


def test_a_scene_far_from_its_origin_comes_with_a_warning() -> None:
    """As in UTM, whose coordinates have seven digits: files of Gaussians hold no more."""
    posed, gaussians = posed_and_gaussians()
    (warning,) = rounding_warnings(posed, given(posed, 4e6), gaussians)
    assert "5,656,85" in warning
    assert "subtract the mean place" in warning


def test_estimated_cameras_and_empty_scenes_have_no_such_warning() -> None:
    posed, gaussians = posed_and_gaussians()
    nothing = replace(gaussians, **{key: field[:0] for key, field in vars(gaussians).items()})
    assert rounding_warnings(posed, None, gaussians) == ()
    assert rounding_warnings(posed, given(posed, 4e6), nothing) == ()
