"""Targets that share nothing with the inputs."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from evaluation_scenes import write_room

from querysplat_cli.evaluation.case import Row
from querysplat_cli.evaluation.judge import Judge
from querysplat_cli.evaluation.metrics import Meter
from querysplat_cli.evaluation.overlap import unmatched_targets
from querysplat_cli.evaluation.plan import Job
from querysplat_cli.evaluation.protocol import Protocol
from querysplat_cli.evaluation.request import EvalRequest
from querysplat_cli.evaluation.run import Setup, handler
from querysplat_cli.evaluation.splits import Case
from querysplat_cli.scene.formats.dataset import Frame, find_scenes
from querysplat_cli.scene.photos import WHOLE, load_photo
from querysplat_cli.scene.pictures import write_picture
from querysplat_cli.scene.views import Photo


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> list[Photo]:
    home = tmp_path_factory.mktemp("data") / "room"
    write_room(home, 4, size=320)
    loaded = [load_photo(frame.file, frame.name, WHOLE) for frame in find_scenes([home])[0].frames]
    return [photo for photo in loaded if isinstance(photo, Photo)]


def test_a_picture_of_something_else_is_apart(photos: list[Photo]) -> None:
    noise = np.random.default_rng(0).integers(0, 255, photos[0].pixels.shape, dtype=np.uint8)
    other = replace(photos[0], name="other.png", path=Path("other.png"), pixels=noise)
    assert unmatched_targets(photos[:2], [photos[2], other]) == {"other.png"}
    assert unmatched_targets(photos[:2], []) == frozenset()
    assert unmatched_targets([other], photos[:2]) == {photo.name for photo in photos[:2]}


@pytest.fixture
def groups(photos: list[Photo], tmp_path: Path) -> dict[str, list[Frame]]:
    """Two inputs, a target that shares their room, and one of noise."""
    noise = np.random.default_rng(0).integers(0, 255, photos[0].pixels.shape, dtype=np.uint8)
    write_picture(tmp_path / "other.png", noise)
    room = [Frame(number, photo.name, "", photo.path) for number, photo in enumerate(photos[:3])]
    return {"input": room[:2], "interp": [room[2]], "extrap": [Frame(3, "other.png", "", tmp_path / "other.png")]}


def test_a_target_is_apart_with_and_without_a_picture(groups: dict[str, list[Frame]]) -> None:
    """Whether a method has a picture of a target does not change what the target is."""
    judge = Judge(groups, {}, Protocol("text"), Meter())
    every = judge.score_pictures(lambda group, frame: judge.truth(frame), "")
    none = judge.score_pictures(lambda group, frame: None, "it has no camera")
    assert none.missing["extrap"] == {"other.png": "it has no camera"}
    assert every.apart == none.apart == {"input": [], "interp": [], "extrap": ["other.png"]}


def test_a_case_that_fails_names_its_targets_apart(groups: dict[str, list[Frame]], tmp_path: Path) -> None:
    (tmp_path / "rival").mkdir()
    request = EvalRequest((), tmp_path / "out", protocol="text", predictions=tmp_path / "rival")
    case = Case("room_000", "room", {})
    handler(Setup(request, None))(Job("small", case, groups, {}, (Row("rival", "querysplat", "free"),)))
    failure = json.loads((tmp_path / "out" / "rival" / "small" / "room_000" / "failure.json").read_text())
    assert "nothing for small, room_000" in failure["error"]
    assert failure["asked"] == {"input": 2, "interp": 1, "extrap": 1}
    assert failure["apart"] == {"input": [], "interp": [], "extrap": ["other.png"]}
