"""Engines do every job once, say how far it is, and go on when a worker is killed."""

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from urllib.request import urlopen

import pytest

from querysplat_cli.runtime.cluster import find_engine, read_cluster
from querysplat_cli.runtime.engine import InProcess, report_progress
from querysplat_cli.runtime.errors import ExitCode, QuerySplatError
from querysplat_cli.runtime.threads import cores
from querysplat_cli.runtime.workers import Workers

JOBS = ["a", "b", "c"]


def handler(folder: Path) -> Callable[[str], None]:
    def handle(job: str) -> None:
        report_progress("half", 0.5)
        if job == "kill" and not (folder / "killed").exists():
            (folder / "killed").write_text(str(os.getpid()))
            os.kill(os.getpid(), signal.SIGKILL)
        if job == "wrong":
            raise QuerySplatError("the job is wrong", "do another")
        if job == "deadly":
            os.kill(os.getpid(), signal.SIGKILL)
        (folder / job).write_text(str(os.getpid()))
        (folder / f"{job}.threads").write_text(os.environ.get("NUMBA_NUM_THREADS", ""))

    return handle


def work(engine: object, folder: Path, jobs: list[str]) -> tuple[dict[str, str | None], set[str]]:
    ends: dict[str, str | None] = {}
    heard: set[str] = set()
    engine.run(handler, folder, jobs, lambda job, why: ends.update({job: why}), lambda job, *_: heard.add(job))  # type: ignore[attr-defined]
    return ends, heard


def test_processes_of_this_machine_are_heard(tmp_path: Path) -> None:
    assert work(Workers(2), tmp_path, JOBS) == (dict.fromkeys(JOBS), set(JOBS))


@pytest.mark.parametrize("engine", [InProcess(), Workers(2)])
def test_what_a_job_raises_is_raised(engine: object, tmp_path: Path) -> None:
    """A worker's error was a traceback, and the job one whose process had ended."""
    with pytest.raises(QuerySplatError, match="the job is wrong") as caught:
        work(engine, tmp_path, ["wrong"])
    assert caught.value.hint == "do another"


def test_in_process(tmp_path: Path) -> None:
    assert work(InProcess(), tmp_path, JOBS) == (dict.fromkeys(JOBS), set(JOBS))
    assert {(tmp_path / job).read_text() for job in JOBS} == {str(os.getpid())}


@pytest.mark.parametrize("text", ["local:2", "tcp://host:8786", "slurm:4"])
def test_clusters_that_there_are(text: str) -> None:
    assert read_cluster(text) == text


@pytest.mark.parametrize("text", ["", "local", "local:0", "local:two", "tcp:host", "http://host", "4"])
def test_other_clusters_are_refused(text: str) -> None:
    with pytest.raises(QuerySplatError, match="no such cluster"):
        read_cluster(text)


def test_what_is_missing_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("querysplat_cli.runtime.cluster.find_spec", lambda name: None)
    with pytest.raises(QuerySplatError, match="needs Dask") as caught:
        find_engine("local:2")
    assert caught.value.code == ExitCode.MISSING_PART
    assert isinstance(find_engine(None), InProcess)


def test_workers_share_the_cores_and_the_main_process_keeps_its_own(tmp_path: Path) -> None:
    """Dask left NUMBA_NUM_THREADS in the main process, where Numba then refused to compile for its running threads."""
    pytest.importorskip("distributed")
    before = dict(os.environ)
    work(find_engine("local:2"), tmp_path, JOBS)
    assert dict(os.environ) == before
    share = before.get("NUMBA_NUM_THREADS", str(max(1, cores() // 2)))
    assert {(tmp_path / f"{job}.threads").read_text() for job in JOBS} == {share}


def test_the_link_leads_to_the_dashboard_of_dask(tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    pytest.importorskip("bokeh")
    said: list[str] = []
    answers: list[int] = []

    def done(job: str, why: str | None) -> None:
        workers, link = said[-1].split(", ")
        assert workers == "1 worker"
        with urlopen(link, timeout=30) as page:
            answers.append(page.status)

    find_engine("local:1", say=said.append).run(handler, tmp_path, ["a"], done, lambda *_: None)
    assert answers == [200]


def test_a_killed_worker_loses_its_job_and_nothing_else(tmp_path: Path) -> None:
    """Two workers of Dask; one of them is killed in the middle of a job, which another one does again."""
    pytest.importorskip("distributed")
    ends, heard = work(find_engine("local:2"), tmp_path, [*JOBS, "kill"])
    assert ends == dict.fromkeys([*JOBS, "kill"])
    assert heard <= {*JOBS, "kill"}
    processes = {(tmp_path / job).read_text() for job in [*JOBS, "kill"]}
    assert str(os.getpid()) not in processes
    assert (tmp_path / "killed").read_text() != (tmp_path / "kill").read_text()


@pytest.fixture
def scheduler() -> Iterator[str]:
    """`dask scheduler` and `dask worker` as commands; gives the scheduler's address."""
    pytest.importorskip("distributed")
    port = 18786
    address, here = f"tcp://127.0.0.1:{port}", str(Path(__file__).parent)
    dask = [sys.executable, "-m", "dask"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([*sys.path, here])}
    started = [
        subprocess.Popen([*dask, *arguments], env=environment, stderr=subprocess.DEVNULL)
        for arguments in (
            ["scheduler", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard"],
            ["worker", address, "--nthreads", "1", "--no-dashboard"],
        )
    ]
    yield address
    for process in started:
        process.terminate()
    for process in started:
        process.wait(30)


def test_a_scheduler_of_its_own(scheduler: str, tmp_path: Path) -> None:
    began = time.monotonic()
    assert work(find_engine(scheduler), tmp_path, JOBS)[0] == dict.fromkeys(JOBS)
    with pytest.raises(QuerySplatError, match="the job is wrong") as caught:
        work(find_engine(scheduler), tmp_path, ["wrong"])
    assert caught.value.hint == "do another"
    assert time.monotonic() - began < 120


def test_no_scheduler(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr("querysplat_cli.runtime.cluster.ANSWER_SECONDS", 1)
    with pytest.raises(QuerySplatError, match="no scheduler answers"):
        work(find_engine("tcp://127.0.0.1:9"), Path(), JOBS)


@pytest.fixture
def slurm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`sbatch` and `scancel` that start and end the jobs as processes of this machine."""
    pytest.importorskip("dask_jobqueue")
    commands = tmp_path / "commands"
    commands.mkdir()
    for name, script in (
        # The file of the job is removed as soon as this returns.
        ("sbatch", 'job=$(cat "$1"); setsid sh -c "$job" >/dev/null 2>&1 & echo "Submitted batch job $!"'),
        ("scancel", 'kill -- "-$1"'),
    ):
        (commands / name).write_text(f"#!/bin/sh\n{script}\n")
        (commands / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{commands}:{os.environ['PATH']}")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([*sys.path, str(Path(__file__).parent)]))


@pytest.mark.usefixtures("slurm")
def test_jobs_of_slurm(tmp_path: Path) -> None:
    import dask.config

    said: list[str] = []
    with dask.config.set({"jobqueue.slurm.cores": 1, "jobqueue.slurm.memory": "2GB"}):
        ends, _ = work(find_engine("slurm:2", say=said.append), tmp_path, JOBS)
    assert ends == dict.fromkeys(JOBS)
    assert str(os.getpid()) not in {(tmp_path / job).read_text() for job in JOBS}
    assert said[0].startswith("waiting for the first worker, http")
    assert re.match("[12] workers?, http", said[1])


@pytest.mark.usefixtures("slurm")
def test_slurm_without_resources(tmp_path: Path) -> None:
    with pytest.raises(QuerySplatError, match="how many cores and how much memory") as caught:
        work(find_engine("slurm:2"), tmp_path, JOBS)
    assert "jobqueue.yaml" in str(caught.value.hint)


def test_no_slurm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("dask_jobqueue")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(QuerySplatError, match="no sbatch here") as caught:
        work(find_engine("slurm:2"), tmp_path, JOBS)
    assert caught.value.code == ExitCode.MISSING_PART


def test_a_job_that_kills_every_worker_is_given_up(tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    ends, _ = work(find_engine("local:1"), tmp_path, ["a", "deadly"])
    assert ends["a"] is None
    assert "lost again and again" in (ends["deadly"] or "")
