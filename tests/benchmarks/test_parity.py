"""Our arithmetic against fixtures of the released one; and the program that compares them fails where it must."""

import json
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

import parity

UNITS = [
    "activations",
    "appearance_decoder",
    "appearance_memory",
    "decoder_block",
    "geometry_decoder",
    "geometry_head",
    "layer_mixer",
    "pipeline",
    "plucker_rays",
    "ply_export",
    "preprocess",
    "querysplat",
    "ssim",
    "vggt_aggregator",
    "vggt_camera_head",
    "vggt_depth_head",
    "vggt_omega_aggregator",
    "vggt_omega_camera_head",
    "vggt_omega_depth_head",
    "vggt_omega_pose_codec",
    "visibility_loss",
]


@pytest.fixture
def folder(golden: Path, tmp_path: Path) -> Path:
    """A copy of the fixture of one small unit, for a test to change."""
    for name in ("geometry_head.json", "geometry_head.safetensors"):
        (tmp_path / name).write_bytes((golden / name).read_bytes())
    return tmp_path


@pytest.mark.parametrize("unit", UNITS)
def test_golden_unit(unit: str, golden: Path) -> None:
    path = golden / f"{unit}.json"
    if not path.is_file():
        pytest.skip(f"no fixture {path}")
    row = parity.compare(parity.Fixture.read(path))
    assert row["ok"], row


def test_prints_one_json_object(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "newcomer.json").write_text('{"unit": "newcomer"}')
    save_file({"a": torch.zeros(1)}, folder / "newcomer.safetensors")
    assert parity.main([str(folder), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["not_covered"] == ["newcomer"]
    assert printed["units"].keys() == {"geometry_head"}
    assert printed["units"]["geometry_head"].keys() == {"max_relative_error", "tolerance", "ok"}


@pytest.mark.parametrize("change", ["value", "not a number", "shape", "weight's name", "output"])
def test_fails_when_something_is_wrong(folder: Path, change: str, capsys: pytest.CaptureFixture[str]) -> None:
    tensors = load_file(folder / "geometry_head.safetensors")
    description = json.loads((folder / "geometry_head.json").read_text())
    if change == "value":
        tensors["scales"] *= 1.0001
    elif change == "not a number":
        tensors["state.deconv.bias"][0] = torch.nan
    elif change == "shape":
        tensors["quats"] = tensors["quats"][:, :-1].contiguous()
    elif change == "weight's name":
        tensors["state.other"] = tensors.pop("state.deconv.bias")
    else:
        description["outputs"].append("unheard_of")
        tensors["unheard_of"] = torch.zeros(1)
    save_file(tensors, folder / "geometry_head.safetensors")
    (folder / "geometry_head.json").write_text(json.dumps(description))
    assert parity.main([str(folder), "--json"]) == 1
    assert not json.loads(capsys.readouterr().out)["units"]["geometry_head"]["ok"]


def test_an_output_that_a_fixture_lacks_is_not_asked_for(folder: Path) -> None:
    tensors = load_file(folder / "geometry_head.safetensors")
    del tensors["with_z_offset"]
    save_file(tensors, folder / "geometry_head.safetensors")
    assert parity.main([str(folder)]) == 0


def test_an_empty_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SystemExit) as stopped:
        parity.main([str(tmp_path)])
    assert stopped.value.code == 2
