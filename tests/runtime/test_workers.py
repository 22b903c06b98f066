"""Worker processes: all jobs are done, and a crash ends one job only."""

import atexit
import os
import signal
import time
from collections.abc import Callable
from multiprocessing import get_context
from pathlib import Path

import psutil
import pytest

from querysplat_cli.runtime.engine import unheard
from querysplat_cli.runtime.threads import THREAD_LIMITS
from querysplat_cli.runtime.workers import Workers, _Pool


def handler(folder: Path) -> Callable[[str], None]:
    def handle(job: str) -> None:
        if job == "crash":
            os._exit(3)
        if job == "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        if job == "terminate":
            atexit.register(os.kill, os.getpid(), signal.SIGTERM)
            os.kill(os.getpid(), signal.SIGTERM)
        if job == "sleep":
            (folder / "started").write_text(str(os.getpid()))
            time.sleep(60)
        (folder / job).write_text(f"{os.getpid()} {os.environ.get(THREAD_LIMITS[0])}")

    return handle


def test_crashes_are_reported_and_the_rest_is_done(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(THREAD_LIMITS[0], raising=False)
    jobs = ["a", "crash", "b", "kill", "c", "d"]
    ends: dict[str, str | None] = {}
    Workers(2).run(handler, tmp_path, jobs, lambda job, why: ends.update({job: why}))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "b", "c", "d"]
    assert ends.keys() == set(jobs)
    assert "code 3" in str(ends["crash"])
    assert "SIGKILL" in str(ends["kill"])
    assert all(ends[job] is None for job in "abcd")
    written = [(tmp_path / job).read_text().split() for job in "abcd"]
    assert str(os.getpid()) not in {process for process, _ in written}
    cores = len(os.sched_getaffinity(0))
    assert {share for _, share in written} == {str(max(1, cores // 2))}
    assert THREAD_LIMITS[0] not in os.environ


def test_a_second_signal_to_end_is_no_error(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Schedulers signal every process, and the main one ends its workers: their clean-up printed a traceback."""
    ends: list[str | None] = []
    Workers(1).run(handler, tmp_path, ["terminate"], lambda job, why: ends.append(why))
    assert ends == ["its process ended with code 143"]
    assert "Traceback" not in capfd.readouterr().err


def test_an_interruption_stops_every_worker(tmp_path: Path) -> None:
    workers = _Pool(2, handler, tmp_path)

    def interrupted(job: str, why: str | None) -> None:
        raise KeyboardInterrupt

    start = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        workers.run(["a", "sleep", "sleep"], interrupted, unheard)
    assert time.monotonic() - start < 30
    assert workers._running
    assert not any(process.is_alive() for process in workers._running)


def test_a_worker_ends_with_the_process_that_started_it(tmp_path: Path) -> None:
    """After SIGKILL nobody waits for its result, and its temporary files may be swept."""
    main = get_context("spawn").Process(target=Workers(1).run, args=(handler, tmp_path, ["sleep"], print))
    main.start()
    worker = psutil.Process(int(_written(tmp_path / "started")))
    main.kill()
    assert not psutil.wait_procs([worker], timeout=20)[1]


def _written(file: Path) -> str:
    until = time.monotonic() + 60
    while not (file.is_file() and file.read_text()):
        assert time.monotonic() < until
        time.sleep(0.05)
    return file.read_text()


def test_workers_that_cannot_start_are_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise the main process would wait for ever."""

    def fail(workers: _Pool[str]) -> None:
        raise OSError("Cannot allocate memory")

    monkeypatch.setattr(_Pool, "_start", fail)
    ends: dict[str, str | None] = {}
    Workers(2).run(handler, tmp_path, ["a", "b", "c"], lambda job, why: ends.update({job: why}))
    assert ends.keys() == {"a", "b", "c"}
    assert all("Cannot allocate memory" in str(why) for why in ends.values())
