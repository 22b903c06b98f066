"""`querysplat weights`: its report on files that are found, damaged, or missing."""

import json
import sys
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from types import ModuleType

import pytest

from querysplat_cli.cli import run
from querysplat_cli.runtime import matching_weights
from querysplat_cli.runtime.errors import ExitCode, MissingPart
from querysplat_cli.runtime.matching_weights import INSTALL, MATCHING_WEIGHTS
from querysplat_cli.runtime.weight_registry import WEIGHTS, find_weights, sha256
from tiny_weights import write_weights


def listed(capsys: pytest.CaptureFixture[str], code: ExitCode, *more: str) -> dict[str, dict[str, object]]:
    assert run(["weights", "--json", "-q", *more]) == code
    return {entry["file"]: entry for entry in json.loads(capsys.readouterr().out)}


def not_installed(name: str) -> None:
    raise PackageNotFoundError(name)


def test_what_is_needed_is_said_where_nothing_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.setattr(matching_weights, "distribution", not_installed)
    found = listed(capsys, ExitCode.DONE, "--weights", str(tmp_path))
    assert len(found) == len(WEIGHTS) + len(MATCHING_WEIGHTS)
    assert found["disk_lightglue.pth"]["command"] == INSTALL
    assert found["disk_lightglue.pth"]["licence"] == "Apache-2.0"
    omega = found["vggt_omega_1b_512.pt"]
    assert omega["gated"] is True
    assert "Noncommercial" in str(omega["licence"])
    assert omega["tensors"] == 1411
    assert omega["gib"] == 4.26
    assert all(entry["path"] is None and entry["absent"] for entry in found.values())
    assert run(["weights", "--weights", str(tmp_path)]) == ExitCode.DONE
    said = capsys.readouterr().err
    assert "huggingface.co/facebook/VGGT-Omega" in said
    assert "c02da418" in said
    assert "".join(INSTALL.split()) in "".join(said.split())


def test_a_damaged_file_of_a_matcher_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "xfeat.pt").write_bytes(b"half of it")
    found = listed(capsys, ExitCode.BAD_INPUT, "--weights", str(tmp_path), "--verify")
    assert "sha256 should be 0f5187fd" in str(found["xfeat.pt"]["fault"])


def test_files_are_read_and_summed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_weights(tmp_path)
    found = listed(capsys, ExitCode.DONE, "--weights", str(tmp_path), "--verify")
    for part, wanted in WEIGHTS.items():
        entry = found[wanted.file]
        assert entry["path"] == str(find_weights(part, tmp_path))
        assert entry["sha256"] == sha256(Path(str(entry["path"])))
        assert entry["fault"] == ""


def test_a_foreign_file_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_weights(tmp_path)
    (tmp_path / "model.safetensors").write_bytes((tmp_path / "vggt_omega_1b_512.safetensors").read_bytes())
    found = listed(capsys, ExitCode.BAD_INPUT, "--weights", str(tmp_path), "--verify")
    assert "does not fit" in str(found["model.safetensors"]["fault"])
    assert found["querysplat_vggto_1B_512_8192.safetensors"]["fault"] == ""


def test_the_cache_is_searched_where_its_library_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """huggingface_hub's function returns a path, None, or a marker for a file that is cached as missing."""
    hub = ModuleType("huggingface_hub")
    answers: dict[str, object] = {"querysplat_vggto_1B_512_8192.safetensors": str(tmp_path / "blob")}
    hub.try_to_load_from_cache = lambda repository, file: answers.get(file, object())  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "huggingface_hub", hub)
    assert find_weights("official-8192", None) == tmp_path / "blob"
    with pytest.raises(MissingPart, match="not in the Hugging Face cache"):
        find_weights("vggt", None)
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(MissingPart, match="needs huggingface_hub") as raised:
        find_weights("vggt", None)
    assert "querysplat[weights]" in raised.value.hint
