"""Generated splits follow their rules, and both forms of split files survive writing and reading."""

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from querysplat_cli.evaluation.generate import INTERVALS, SCALES, generate
from querysplat_cli.evaluation.policy import EVALUATION_POLICY
from querysplat_cli.evaluation.splits import (
    Case,
    FrameRef,
    Split,
    read_splits,
    resolve,
    spacing,
    write_index,
    write_split,
)
from querysplat_cli.runtime.errors import ImpossibleScene, QuerySplatError
from querysplat_cli.scene.formats.dataset import CapturedScene, Frame


def scene(name: str, count: int, *, first: int = 0) -> CapturedScene:
    frames = tuple(
        Frame(first + i, f"frame_{i:05d}.png", "images_4", Path(f"/data/{name}/images_4/frame_{i:05d}.png"))
        for i in range(count)
    )
    return CapturedScene(name, frames, {}, ())


@given(
    views=st.sampled_from(sorted(INTERVALS)),
    scale=st.sampled_from(SCALES),
    counts=st.lists(st.integers(1, 120), min_size=1, max_size=4),
    cases=st.integers(1, 12),
    seed=st.integers(0, 5),
)
def test_generated_cases_follow_the_rules(views: int, scale: str, counts: list[int], cases: int, seed: int) -> None:
    scenes = [scene(f"s{i}", count, first=7 * i) for i, count in enumerate(counts)]
    interval = INTERVALS[views][SCALES.index(scale)]
    need = (views - 1) * interval + 1 + EVALUATION_POLICY.generated_targets
    if max(counts) < need:
        with pytest.raises(ImpossibleScene, match=str(need)):
            generate(scenes, "data", views, scale, cases=cases, seed=seed)
        return
    split = generate(scenes, "data", views, scale, cases=cases, seed=seed)
    assert split == generate(scenes, "data", views, scale, cases=cases, seed=seed)
    assert len({case.name for case in split.cases}) == len(split.cases) == cases
    for case in split.cases:
        home = next(each for each in scenes if each.name == case.scene)
        inputs, interp, extrap = ([ref.frame_index for ref in case.groups[g]] for g in ("input", "interp", "extrap"))
        assert len(set(interp)) == len(set(extrap)) == EVALUATION_POLICY.generated_targets
        assert inputs == list(range(inputs[0], inputs[0] + (views - 1) * interval + 1, interval))
        assert all(inputs[0] < i < inputs[-1] and i not in inputs for i in interp)
        reach = max(interval, EVALUATION_POLICY.generated_targets)
        assert all(inputs[0] - reach <= i < inputs[0] or inputs[-1] < i <= inputs[-1] + reach for i in extrap)
        found = resolve(case, home)
        assert [frame.index for frame in found["extrap"]] == extrap


def test_scenes_take_turns_and_seeds_differ() -> None:
    scenes = [scene("a", 80), scene("b", 3), scene("c", 80)]
    split = generate(scenes, "data", 4, "medium", cases=6, seed=1)
    assert [case.scene for case in split.cases] == ["a", "c"] * 3
    assert split != generate(scenes, "data", 4, "medium", cases=6, seed=2)
    assert spacing(split) == f"inputs {INTERVALS[4][1]} frames apart"


def test_the_releases_form_comes_back(tmp_path: Path) -> None:
    split = generate([scene("a", 80)], "DL3DV-Evaluation", 12, "large", cases=3, seed=0)
    write_split(tmp_path / "12views_large.json", split)
    content = json.loads((tmp_path / "12views_large.json").read_text())
    assert content.keys() == {"dataset_path", "total_samples", "num_input_views", "scale", "samples"}
    assert content["samples"][0].keys() == {"scene_id", "input_views", "interp_views", "extrap_views"}
    assert content["samples"][0]["input_views"][0].keys() == {"path", "frame_index"}
    assert content["samples"][0]["input_views"][0]["path"].startswith("DL3DV-Evaluation/a/images_4/frame_")
    assert read_splits(tmp_path) == [split]


def test_index_files_are_divided_into_inputs_interpolation_and_extrapolation(tmp_path: Path) -> None:
    """TokenGS's and DepthSplat's targets hold the inputs; null stands for scenes that are left out."""
    file = tmp_path / "dl3dv.json"
    entries = {
        "aa": {"context": [40, 10], "target": [0, 10, 20, 30, 40, 45]},
        "bb": None,
        "cc": {"context": [5, 1, 3, 9], "target": [2, 9]},
    }
    file.write_text(json.dumps(entries))
    two, four = read_splits(file)
    assert (two.name, two.views, four.name, four.views) == ("dl3dv_2views", 2, "dl3dv_4views", 4)
    groups = {group: [ref.frame_index for ref in refs] for group, refs in two.cases[0].groups.items()}
    assert groups == {"input": [10, 40], "interp": [20, 30], "extrap": [0, 45]}
    assert [frame.index for frame in resolve(two.cases[0], scene("aa", 50))["extrap"]] == [0, 45]
    write_index(tmp_path / "again.index.json", two)
    assert json.loads((tmp_path / "again.index.json").read_text()) == {
        "aa": {"context": [10, 40], "target": [0, 10, 20, 30, 40, 45]}
    }


def test_frames_are_found_by_name_in_renamed_folders() -> None:
    split = generate([scene("a", 80)], "DL3DV-Evaluation", 2, "small", cases=1, seed=0)
    shifted = scene("a", 80, first=100)  # other numbers, same names
    names = [Path(ref.path).name for ref in split.cases[0].inputs]
    assert [frame.name for frame in resolve(split.cases[0], shifted)["input"]] == names
    with pytest.raises(QuerySplatError, match="is not there"):
        resolve(split.cases[0], scene("a", 2))


def test_names_that_repeat_in_folders_stay_separate() -> None:
    frames = tuple(
        Frame(i, name, "images", Path(name)) for i, name in enumerate(["left/1.png", "right/1.png", "2.png"])
    )
    rig = CapturedScene("rig", frames, {}, ())
    refs = tuple(FrameRef(f"data/rig/images_8/{name}", 0) for name in ("right/1.png", "left/1.png", "left/2.png"))
    assert [frame.index for frame in resolve(Case("rig", "rig", {"input": refs}), rig)["input"]] == [1, 0, 2]


@pytest.mark.parametrize("path", ["/etc/passwd", "DL3DV/../../secret.png", "C:\\x.png", "a\\..\\b.png"])
def test_paths_that_leave_the_dataset_are_refused(tmp_path: Path, path: str) -> None:
    view = [{"path": path, "frame_index": 0}]
    sample = {"scene_id": "a", "input_views": view, "interp_views": [], "extrap_views": []}
    content = {"dataset_path": "d", "total_samples": 1, "num_input_views": 2, "scale": "small", "samples": [sample]}
    (tmp_path / "s.json").write_text(json.dumps(content))
    with pytest.raises(QuerySplatError, match="leaves the dataset"):
        read_splits(tmp_path / "s.json")


@pytest.mark.parametrize(
    "text", ["[]", "{}", '{"a": 1}', '{"a": {"context": []}}', "no json", '{"samples": [{}]}', "7"]
)
def test_other_files_are_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "s.json").write_text(text)
    with pytest.raises(QuerySplatError):
        read_splits(tmp_path / "s.json")


def test_a_scene_cannot_name_a_folder_elsewhere(tmp_path: Path) -> None:
    (tmp_path / "s.json").write_text(json.dumps({"../x": {"context": [0, 9], "target": [3]}}))
    (split,) = read_splits(tmp_path / "s.json")
    assert isinstance(split, Split)
    assert "/" not in split.cases[0].name


def test_a_case_of_a_scene_that_cannot_be_read_says_why() -> None:
    damaged = CapturedScene("s", (), {}, (), fault="transforms.json: cut off")
    case = Case("s_000", "s", {"input": (FrameRef("", 0),)})
    with pytest.raises(QuerySplatError, match="cut off"):
        resolve(case, damaged)
