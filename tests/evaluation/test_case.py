"""Cameras of whole photos, from those of padded or cropped network inputs; what rows share."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from evaluation_scenes import write_room

from querysplat_cli.encoders.base import PosedViews
from querysplat_cli.evaluation.cameras import cameras_by_name
from querysplat_cli.evaluation.case import same_parts
from querysplat_cli.evaluation.judge import Judge
from querysplat_cli.evaluation.metrics import Meter
from querysplat_cli.evaluation.protocol import Protocol
from querysplat_cli.pipeline.settings import ReconstructSettings
from querysplat_cli.runtime.choices import Fit
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.fit import network_views
from querysplat_cli.scene.formats.dataset import find_scenes
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.views import Photo


def posed(sizes: list[tuple[int, int]], fit: Fit) -> PosedViews:
    """Photos fitted to a network of 112 pixels, each with its principal point in the middle."""
    photos = [Photo(f"{i}.png", Path(f"{i}.png"), np.zeros((*size, 3), np.uint8)) for i, size in enumerate(sizes)]
    views = network_views(photos, 112, 16, fit)
    height, width = views.sizes[0]
    K = torch.tensor([[100.0, 0, width / 2], [0, 100, height / 2], [0, 0, 1]]).expand(len(sizes), 3, 3)
    cameras = Cameras(torch.eye(4).expand(len(sizes), 4, 4), K, height, width)
    return PosedViews(views, cameras, torch.zeros(0, 3), (torch.zeros(0, dtype=torch.long),) * len(sizes))


def test_a_padded_photos_camera_is_that_of_the_photo_alone() -> None:
    cameras = cameras_by_name(posed([(128, 256), (256, 128), (200, 200)], "pad"))
    assert [(camera.height, camera.width) for camera in cameras.values()] == [(56, 112), (112, 56), (112, 112)]
    for camera in cameras.values():
        assert camera.principal == (camera.width / 2, camera.height / 2)
        assert camera.focal == (100, 100)


def test_a_view_that_was_cropped_away_is_refused(tmp_path: Path) -> None:
    write_room(tmp_path / "room", 1)
    (scene,) = find_scenes([tmp_path])
    judge = Judge({"input": scene.frames}, scene.cameras, Protocol("text"), Meter())
    name = scene.frames[0].name
    _, shown = judge.photos[name]
    speck = Gaussians(*(torch.ones(1, *shape) for shape in ((3,), (4,), (3,), (), (1, 3))))
    square = cameras_by_name(posed([(shown.height, shown.width)], "crop"))["0.png"]
    with pytest.raises(QuerySplatError, match=f"saw only 112 × 112 of {name}"):
        judge.score_scene(speck, {name: square}, "")


def test_settings_of_the_scene_share_model_and_encoder() -> None:
    """Rows of a sweep find cameras and depth once."""
    usual = ReconstructSettings(inputs=())
    same = [replace(usual, **{name: value}) for name, value in (("prune", "off"), ("quality", "draft"), ("tto", 3))]
    assert {same_parts(each) for each in same} == {same_parts(usual)}
    assert same_parts(replace(usual, matcher="sift")) != same_parts(usual)
