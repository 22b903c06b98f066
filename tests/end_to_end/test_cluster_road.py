"""Regions on Dask's workers, as commands: a worker that is killed changes nothing in the scene."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from common.street_photos import take_street

pytestmark = pytest.mark.slow
ADDRESS = "tcp://127.0.0.1:18787"
SECONDS = 600


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("distributed")
    folder = tmp_path_factory.mktemp("street") / "photos"
    take_street(folder, 10, length=4.0, width=144, samples=1)
    return folder


def started(street: Path, name: str, cluster: str) -> "subprocess.Popen[bytes]":
    command = [sys.executable, "-m", "querysplat_cli", "reconstruct", str(street), "-o", str(street.parent / name)]
    poses = ["--poses", str(street.parent / "transforms.json"), "--max-size", "112", "--tto", "8", "--quality", "draft"]
    return subprocess.Popen([*command, *poses, "--regions", "2", "--cluster", cluster, "-q"])


@pytest.fixture(scope="module")
def undisturbed(street: Path) -> bytes:
    assert started(street, "whole.ply", "local:2").wait(SECONDS) == 0
    return (street.parent / "whole.ply").read_bytes()


def killed_in_a_region(street: Path, name: str, processes: list[psutil.Process]) -> None:
    """Wait until a region has its depth and not its scene, and kill the busiest of `processes`."""
    region = street.parent / f".{name}.unfinished" / "region-1"
    for _ in range(20 * SECONDS):
        if (region / "depth.pt").exists():
            break
        time.sleep(0.05)
    assert (region / "depth.pt").exists(), "the region never had its depth"
    assert not (region / "scene.pt").exists(), "the region was done before the kill"
    children = [child for process in processes for child in process.children(recursive=True)]
    workers = [child for child in children if "spawn_main" in " ".join(child.cmdline())]
    os.kill(max(workers, key=lambda child: sum(child.cpu_times()[:2])).pid, signal.SIGKILL)


def test_one_of_two_workers_is_killed(street: Path, undisturbed: bytes) -> None:
    run = started(street, "local.ply", "local:2")
    killed_in_a_region(street, "local.ply", [psutil.Process(run.pid)])
    assert run.wait(SECONDS) == 0
    assert (street.parent / "local.ply").read_bytes() == undisturbed


@pytest.fixture
def scheduler() -> Iterator[list["subprocess.Popen[bytes]"]]:
    """`dask scheduler` and two times `dask worker`; each worker has one thread, as those of local:2 have here."""
    dask = [sys.executable, "-m", "dask"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    share = str(max(1, len(os.sched_getaffinity(0)) // 2))
    environment |= dict.fromkeys(("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "MKL_NUM_THREADS"), share)
    worker = ["worker", ADDRESS, "--nthreads", "1", "--no-dashboard"]
    processes = [
        subprocess.Popen([*dask, *arguments], env=environment, stderr=subprocess.DEVNULL)
        for arguments in (["scheduler", "--port", ADDRESS.rpartition(":")[2], "--no-dashboard"], worker, worker)
    ]
    yield processes
    for process in processes:
        process.terminate()
    for process in processes:
        process.wait(60)


def test_the_same_through_a_scheduler(
    street: Path, undisturbed: bytes, scheduler: list["subprocess.Popen[bytes]"]
) -> None:
    run = started(street, "tcp.ply", ADDRESS)
    killed_in_a_region(street, "tcp.ply", [psutil.Process(process.pid) for process in scheduler[1:]])
    assert run.wait(SECONDS) == 0
    assert (street.parent / "tcp.ply").read_bytes() == undisturbed


def test_the_command_itself_is_killed_and_repeated(street: Path, undisturbed: bytes) -> None:
    run = started(street, "again.ply", "local:2")
    region = street.parent / ".again.ply.unfinished"
    for _ in range(20 * SECONDS):
        if any(region.glob("region-*/scene.pt")):
            break
        time.sleep(0.05)
    run.kill()
    run.wait()
    time.sleep(5)  # until Dask's own processes see that they are alone
    assert started(street, "again.ply", "local:2").wait(SECONDS) == 0
    assert (street.parent / "again.ply").read_bytes() == undisturbed
    assert not region.exists()
