"""What containers allow, by files as the kernel writes them for both versions of control groups."""

from pathlib import Path

import pytest

from querysplat_cli.runtime import containers, limits, threads
from querysplat_cli.runtime.errors import MissingPart

GIB = 2**30


def groups(folder: Path, monkeypatch: pytest.MonkeyPatch, own: str, files: dict[str, str]) -> None:
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    (folder / "own").write_text(own)
    monkeypatch.setattr(containers, "MOUNTED", folder)
    monkeypatch.setattr(containers, "OWN", folder / "own")


def test_the_tightest_group_of_version_2_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = {
        "job/memory.max": f"{4 * GIB}\n",
        "job/memory.current": f"{3 * GIB}\n",
        "job/memory.stat": f"anon {GIB}\ninactive_file {GIB}\n",  # files that can be dropped take no memory
        "job/step/memory.max": "max\n",
        "job/step/memory.current": f"{GIB}\n",
        "job/step/cpu.max": "max 100000\n",
        "job/cpu.max": "150000 100000\n",
    }
    groups(tmp_path, monkeypatch, "0::/job/step\n", files)
    assert containers.free_memory() == 2 * GIB
    assert containers.cores() == 2
    assert limits.free_memory() <= 2 * GIB
    assert 1 <= threads.cores() <= 2


def test_version_1_has_a_folder_for_each_controller(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As inside a container: the path of the group is that of the host, and its files are those of the root."""
    files = {
        "memory/memory.limit_in_bytes": f"{2 * GIB}\n",
        "memory/memory.usage_in_bytes": f"{3 * GIB}\n",
        "memory/memory.stat": "total_inactive_file 0\n",
        "cpu/cpu.cfs_quota_us": "50000\n",
        "cpu/cpu.cfs_period_us": "100000\n",
    }
    groups(tmp_path, monkeypatch, "4:memory:/docker/abc\n1:cpu,cpuacct:/docker/abc\n0::/\n", files)
    assert containers.free_memory() == 0
    assert containers.cores() == 1


@pytest.mark.parametrize("own", ["", "0::/\n", "1:cpu:/\n4:memory:/\n"])
def test_no_limit(own: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = {"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n", "memory.max": "max\n"}
    groups(tmp_path, monkeypatch, own, files)
    assert containers.free_memory() is None
    assert containers.cores() is None
    environment: dict[str, str] = {}
    threads.limit_threads(environment)
    assert not environment


def test_no_more_threads_than_the_container_has_cores(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    groups(tmp_path, monkeypatch, "0::/\n", {"cpu.max": "100000 100000\n"})
    environment = {"OMP_NUM_THREADS": "7"}
    threads.limit_threads(environment)
    assert environment == {"OMP_NUM_THREADS": "7", "NUMBA_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


def test_the_address_space_is_that_of_the_cores_that_the_process_may_use(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a host of 64 cores a job of one was refused, for want of the address space of 64."""
    monkeypatch.setattr(limits, "_limit", lambda: 3 * GIB)
    monkeypatch.setattr("os.cpu_count", lambda: 64)
    monkeypatch.setattr("os.sched_getaffinity", lambda process: {0})
    limits.check_address_space("reconstruct")
    monkeypatch.setattr("os.sched_getaffinity", lambda process: set(range(64)))
    monkeypatch.setattr(containers, "cores", lambda: None)
    with pytest.raises(MissingPart, match=r"is 3\.0 GiB, and about 11\.8 are needed"):
        limits.check_address_space("reconstruct")
