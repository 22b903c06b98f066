"""Scores of other methods' pictures and scenes, in any frame and under any accepted file name."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from evaluation_scenes import write_room
from scipy.spatial.transform import Rotation

from querysplat_cli.evaluation import fitted
from querysplat_cli.evaluation.baseline import back_project
from querysplat_cli.evaluation.cameras import to_frame_of
from querysplat_cli.evaluation.judge import Judge, RowResult
from querysplat_cli.evaluation.metrics import Meter
from querysplat_cli.evaluation.policy import FittingPolicy
from querysplat_cli.evaluation.predictions import score_prediction
from querysplat_cli.evaluation.protocol import Protocol
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.formats.dataset import CapturedScene, find_scenes
from querysplat_cli.scene.formats.ply import write_ply
from querysplat_cli.scene.formats.transforms import write_transforms
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.sim3 import Sim3
from querysplat_cli.scene.views import Views
from querysplat_cli.splat.conventions import EQUAL_PSNR
from querysplat_cli.splat.transform import transform_gaussians

PICKED = {"input": (0, 3, 6), "interp": (1, 4), "extrap": (7,)}


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> CapturedScene:
    home = tmp_path_factory.mktemp("data") / "room"
    write_room(home, 8)
    return find_scenes([home])[0]


@pytest.fixture(params=["release", "text"])
def judge(room: CapturedScene, request: pytest.FixtureRequest) -> Judge:
    groups = {group: [room.frames[i] for i in rows] for group, rows in PICKED.items()}
    return Judge(groups, room.cameras, Protocol(request.param), Meter())


@pytest.fixture
def scene(judge: Judge) -> Gaussians:
    """Two photos, each on a slanted wall. Rounding would sort equal depths, those of a wall that faces its camera."""
    names = [frame.name for frame in judge.groups["input"]][:2]
    shown = [judge.photos[name][1].pixels for name in names]
    images = torch.stack([torch.from_numpy(pixels).permute(2, 0, 1).float() / 255 for pixels in shown])
    given = [judge.known[name] for name in names]
    K = torch.tensor([[[a.focal[0], 0, a.principal[0]], [0, a.focal[1], a.principal[1]], [0, 0, 1]] for a in given])
    w2c = torch.stack([torch.from_numpy(camera.w2c).float() for camera in given])
    height, width = images.shape[2:]
    views = Views(images, torch.ones(2, height, width, dtype=torch.bool), tuple(names), ((height, width),) * 2)
    depth = torch.linspace(2.9, 3.1, height * width).reshape(height, width)
    return back_project(views, Cameras(w2c, K.float(), height, width), depth.expand(2, -1, -1))


def flat(result: RowResult) -> dict[tuple[str, str], float]:
    return {(group, view.frame.name): view.scores.psnr for group, views in result.views.items() for view in views}


def test_the_truth_scores_best_under_every_name(judge: Judge, tmp_path: Path) -> None:
    """Named like the photo or by its number, in the group's folder or in another one."""
    for group, frames in judge.groups.items():
        for number, frame in enumerate(frames):
            name = Path(frame.name).stem if number % 2 else f"{frame.index:04d}"
            folder = tmp_path / "case" / ("color" if group == "extrap" else group)
            folder.mkdir(parents=True, exist_ok=True)
            pixels = (judge.truth(frame).permute(1, 2, 0).numpy() * 255).round().astype(np.uint8)
            cv2.imwrite(str(folder / f"{name}.png"), pixels[..., ::-1])
    result = score_prediction(judge, tmp_path, "split", "case")
    assert len(flat(result)) == 6
    # Truths of `release` are not whole bytes: rounding them is an error of 59 dB.
    assert min(flat(result).values()) > (58 if judge.protocol.name == "release" else EQUAL_PSNR - 1)
    assert result.gaussians is None
    larger = tmp_path / "larger" / "case"
    larger.mkdir(parents=True)
    height, width = (2 * size for size in judge.truth(frame).shape[1:])
    cv2.imwrite(str(larger / f"{name}.png"), cv2.resize(pixels[..., ::-1], (width, height)))
    assert flat(score_prediction(judge, tmp_path / "larger", "split", "case"))["extrap", frame.name] > 28
    (tmp_path / "case" / "color" / "0007.png").unlink()
    assert score_prediction(judge, tmp_path, "split", "case").missing["extrap"] == {
        "frame_00008.png": "no picture of it is there"
    }


def test_a_scene_in_another_frame_scores_the_same(judge: Judge, scene: Gaussians, tmp_path: Path) -> None:
    """Only the inputs' cameras are given. The targets' come from the dataset, by the similarity of the inputs'."""
    expected = judge.score_scene(scene, judge.known, "")
    similarity = Sim3(
        1.7,
        torch.from_numpy(Rotation.from_euler("xyz", [0.4, 1.9, -1.0]).as_matrix()),
        torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64),
    )
    folder = tmp_path / "split" / "case"
    folder.mkdir(parents=True)
    write_ply(folder / "gaussians.ply", transform_gaussians(scene, similarity))
    inputs = {frame.name: judge.known[frame.name] for frame in judge.groups["input"]}
    bare = Cameras(torch.stack([torch.from_numpy(a.w2c) for a in inputs.values()]), torch.eye(3).repeat(3, 1, 1), 1, 1)
    theirs = {
        name: replace(camera, w2c=w2c.numpy())
        for (name, camera), w2c in zip(inputs.items(), bare.transformed(similarity).w2c, strict=True)
    }
    write_transforms(folder / "cameras.json", theirs)
    result = score_prediction(judge, tmp_path, "split", "case")
    assert result.missing == {"input": {}, "interp": {}, "extrap": {}}
    assert flat(result) == pytest.approx(flat(expected), abs=0.05)
    assert result.gaussians == len(scene)
    again = to_frame_of(inputs, theirs)
    np.testing.assert_allclose(again["frame_00001.png"].w2c, inputs["frame_00001.png"].w2c, atol=1e-6)


def test_a_scene_alone_is_in_the_datasets_frame(judge: Judge, scene: Gaussians, tmp_path: Path) -> None:
    (tmp_path / "case").mkdir()
    write_ply(tmp_path / "case" / "scene.ply", scene)
    assert flat(score_prediction(judge, tmp_path, "split", "case")) == pytest.approx(
        flat(judge.score_scene(scene, judge.known, "")), abs=0.01
    )


def save(file: Path, picture: torch.Tensor) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    pixels = (picture.clamp(0, 1).permute(1, 2, 0).numpy() * 255).round().astype(np.uint8)
    cv2.imwrite(str(file), pixels[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 100])


LAYOUTS = {
    "DepthSplat": ("color/{index:0>6}.png", "color/{index:0>6}_gt.png"),
    "NoPoSplat": ("color/{index:0>6}.png", "context/{index:0>6}.png"),
    "SPFSplat": ("color/{index:0>6}.png", None),
    "YoNoSplat": ("color/{index:0>6}.png", "context/{index:0>6}.png"),
    "AnySplat": ("pred/{target:0>6}.jpg", "gt/{target:0>6}.jpg"),
    "SplatWeaver": ("pred/{target:0>6}.jpg", "gt/{target:0>6}.jpg"),
}
"""Where a system puts its render of a target, and where photos, if it does. `target` counts targets from 0."""


@pytest.mark.parametrize("system", LAYOUTS)
def test_the_layouts_of_other_systems(system: str, judge: Judge, tmp_path: Path) -> None:
    """As docs/other-methods.md shows them. Their copies of photos are never scored."""
    case, listed, expected = tmp_path / "case", {}, {}
    targets = [(group, frame) for group in ("interp", "extrap") for frame in judge.groups[group]]
    for number, (group, frame) in enumerate(targets):
        truth = judge.truth(frame)
        render = (0.8 - 0.1 * number) * truth  # another error for each view, which JPEG keeps
        ours = LAYOUTS[system][0].format(index=frame.index, target=number)
        save(case / ours, render)
        if photo := LAYOUTS[system][1]:
            save(case / photo.format(index=frame.index, target=number), truth)
        listed[frame.name] = ours
        expected[group, frame.name] = -10 * float((render - truth).square().mean().log10())
    for frame in judge.groups["input"]:
        if photo := LAYOUTS[system][1]:
            save(case / photo.format(index=frame.index, target=90 + frame.index), judge.truth(frame))
    if system == "SplatWeaver":
        save(case / "expert_selection.png", torch.zeros(3, 30, 90))
    if "target" in LAYOUTS[system][0]:
        (case / "views.json").write_text(json.dumps(listed))
    result = score_prediction(judge, tmp_path, "split", "case")
    assert flat(result) == pytest.approx(expected, abs=0.3)
    assert len(result.missing["input"]) == 3
    assert result.warnings == ()


def test_tokengs_scenes_are_scored_with_a_list_of_cameras(judge: Judge, scene: Gaussians, tmp_path: Path) -> None:
    """Its evaluation writes gaussians/gaussians_0-0-0.ply. The cameras of its frame are the user's to add."""
    case = tmp_path / "case"
    (case / "gaussians").mkdir(parents=True)
    write_ply(case / "gaussians" / "gaussians_0-0-0.ply", scene)
    write_transforms(case / "cameras.json", {frame.name: judge.known[frame.name] for frame in judge.groups["input"]})
    found = flat(score_prediction(judge, tmp_path, "split", "case"))
    assert found == pytest.approx(flat(judge.score_scene(scene, judge.known, "")), abs=0.05)


def test_of_several_scenes_the_first_is_scored_with_a_doubt(judge: Judge, scene: Gaussians, tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / "case" / name).mkdir(parents=True)
        write_ply(tmp_path / "case" / name / "points.ply", scene)
        found = score_prediction(judge, tmp_path, "split", "case")
        assert found.warnings == (() if name == "a" else (found.warnings[-1],))
    assert found.warnings[0].startswith("there are 2 files of Gaussians or points, and a/points.ply is scored")


def test_fitted_scores_stand_beside_those_of_the_protocol(
    judge: Judge, room: CapturedScene, scene: Gaussians, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For targets alone, and without any change of the protocol's scores."""
    monkeypatch.setattr(fitted, "FITTING_POLICY", FittingPolicy(steps=2, blurs=(3, 1)))
    plain = judge.score_scene(scene, judge.known, "")
    both = Judge(judge.groups, room.cameras, judge.protocol, Meter(), fitted=True)
    found = both.score_scene(scene, judge.known, "")
    assert flat(found) == flat(plain)
    for group, views in found.views.items():
        for view in views:
            assert (view.scores.psnr_fitted is None) == (group == "input")
    assert not any(view.scores.psnr_fitted for views in plain.views.values() for view in views)


def test_photos_in_place_of_renders_are_doubted(judge: Judge, tmp_path: Path) -> None:
    frame = judge.groups["interp"][0]
    if judge.protocol.name == "release":
        pytest.skip("truths of `release` are not whole bytes")
    save(tmp_path / "case" / f"{frame.index}.png", judge.truth(frame))
    (doubt,) = score_prediction(judge, tmp_path, "split", "case").warnings
    assert doubt == f"1 pictures are equal to their photos ({frame.name}): are they renders?"


@pytest.mark.parametrize("listed", ["[]", '{"a.png": 3}', '{"a.png": "nowhere.png"}', '{"a.png": "../out.png"}', "{"])
def test_a_wrong_list_of_names_is_refused(listed: str, judge: Judge, tmp_path: Path) -> None:
    save(tmp_path / "out.png", judge.truth(judge.groups["input"][0]))
    (tmp_path / "case").mkdir()
    (tmp_path / "case" / "views.json").write_text(listed)
    with pytest.raises(QuerySplatError, match=r"views\.json"):
        score_prediction(judge, tmp_path, "split", "case")


def test_what_cannot_be_scored(judge: Judge, tmp_path: Path) -> None:
    with pytest.raises(QuerySplatError, match="nothing for split, case"):
        score_prediction(judge, tmp_path, "split", "case")
    (tmp_path / "case").mkdir()
    with pytest.raises(QuerySplatError, match="neither a"):
        score_prediction(judge, tmp_path, "split", "case")
    cv2.imwrite(str(tmp_path / "case" / "frame_00001.png"), np.zeros((100, 300, 3), np.uint8))
    with pytest.raises(QuerySplatError, match="is 300 × 100, the target"):
        score_prediction(judge, tmp_path, "split", "case")


def test_a_parent_folder_that_is_named_like_a_group_says_nothing(judge: Judge, tmp_path: Path) -> None:
    """Below a folder `input`, a depth map was scored in place of the render."""
    folder = tmp_path / "input" / "case"
    frame = judge.groups["input"][0]
    save(folder / "depth" / f"{Path(frame.name).stem}.png", torch.zeros_like(judge.truth(frame)))
    save(folder / "input" / f"{Path(frame.name).stem}.png", judge.truth(frame))
    assert flat(score_prediction(judge, folder.parent, "split", "case"))["input", frame.name] > 50
