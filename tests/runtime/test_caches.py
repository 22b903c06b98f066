"""Without a home directory, libraries keep their caches in a temporary folder of the user's own."""

import os
import stat
from pathlib import Path

import pytest

from querysplat_cli.runtime import caches
from querysplat_cli.runtime.caches import find_caches, hub_checkpoints


@pytest.fixture
def nowhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """An environment in which neither the package nor the home directory can be written. Root can write anywhere."""
    monkeypatch.setattr(caches, "_writable", lambda folder: False)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    return {}


def test_a_home_is_used_where_there_is_one(tmp_path: Path) -> None:
    environment = {"XDG_CACHE_HOME": str(tmp_path / "cache")}
    find_caches(environment)
    assert environment == {"XDG_CACHE_HOME": str(tmp_path / "cache")}


def test_the_temporary_folder_is_the_users_own_and_the_same_again(nowhere: dict[str, str], tmp_path: Path) -> None:
    again = dict(nowhere)
    find_caches(nowhere)
    find_caches(again)
    assert again == nowhere
    assert nowhere.keys() == {"NUMBA_CACHE_DIR", "MPLCONFIGDIR"}
    (folder,) = tmp_path.iterdir()
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert {Path(place).parent for place in nowhere.values()} == {folder}


def test_a_folder_that_others_can_write_is_not_trusted(nowhere: dict[str, str], tmp_path: Path) -> None:
    """numba runs what it finds in its cache."""
    planted = tmp_path / f"querysplat-cache-{os.getuid()}"
    planted.mkdir(mode=0o777)
    planted.chmod(0o777)
    find_caches(nowhere)
    assert Path(nowhere["NUMBA_CACHE_DIR"]).parent != planted


def test_what_the_user_has_set_stays(nowhere: dict[str, str]) -> None:
    nowhere |= {"NUMBA_CACHE_DIR": "/mine", "MPLCONFIGDIR": "/mine too"}
    find_caches(nowhere)
    assert nowhere == {"NUMBA_CACHE_DIR": "/mine", "MPLCONFIGDIR": "/mine too"}


@pytest.mark.parametrize(
    ("environment", "torch"),
    [
        ({"TORCH_HOME": "/t", "XDG_CACHE_HOME": "/x"}, "/t"),
        ({"XDG_CACHE_HOME": "/x"}, "/x/torch"),
        ({"HOME": "/h"}, "/h/.cache/torch"),
    ],
)
def test_the_cache_of_torch_hub(environment: dict[str, str], torch: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("TORCH_HOME", "XDG_CACHE_HOME", "HOME"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert hub_checkpoints() == [Path(torch) / "hub" / "checkpoints"]
