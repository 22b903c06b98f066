"""Runs one case, and compares what it did with what it should."""

import contextlib
import hashlib
import os
import resource
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

SLOW = 10.0
STUCK = 240
"""Seconds after which a case is ended."""
CACHES = ("torchinductor_", "querysplat-cache-")
"""Temporary folders that serve all runs: torch's, and the one of users without a home directory."""
REPLACED = ("out/", "out.lod/")
"""Folders that a command replaces as a whole."""
PROGRAM = (sys.executable, "-m", "querysplat_cli")


@dataclass(frozen=True)
class Outcome:
    """What a case did. `faults` names what is not clean.

    A kill has the `instants` that were drawn, in CPU seconds (of a server: seconds); it `reached` the command when it
    ended it, at the last of them.
    """

    family: str
    what: str
    code: int
    seconds: float
    message: str
    written: list[str]
    faults: list[str]
    reached: bool = False
    instants: list[float] = field(default_factory=list)


def snapshot(folder: Path) -> dict[str, str]:
    """A digest of every file below `folder`, by path."""
    return {
        str(path.relative_to(folder)): hashlib.sha1(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not path.is_symlink()
    }


@contextlib.contextmanager
def captured(file: Path) -> Iterator[None]:
    """Inside, everything that this process prints, native libraries included, goes to `file`."""
    sys.stdout.flush()
    sys.stderr.flush()
    kept = [os.dup(number) for number in (1, 2)]
    with file.open("wb") as target:
        for number in (1, 2):
            os.dup2(target.fileno(), number)
    try:
        yield
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        for number, old in zip((1, 2), kept, strict=True):
            os.dup2(old, number)
            os.close(old)


def attempt(case: Any, scratch: Path) -> Outcome:
    """Run one case in a new folder below `scratch`."""
    from hostile.whole import half_written, next_run

    home = Path(tempfile.mkdtemp(dir=scratch))
    work, temporary, log = home / "work", home / "tmp", home / "log"
    work.mkdir()
    temporary.mkdir()
    case.make(work)
    before = snapshot(work)
    run, clock = (_call, time.process_time) if case.kind == "call" else (_process, time.perf_counter)
    started = clock()
    code, faults = run(case, work, temporary, log)
    seconds = clock() - started
    text = log.read_text(errors="replace")
    if code == -signal.SIGKILL:
        next_run(work, temporary)
    after = snapshot(work)
    outside = [path.name for path in home.iterdir() if path.name not in ("work", "tmp", "log")]
    faults += _faults(case, code, seconds, text, before, after)
    left = sorted(path.name for path in temporary.iterdir() if not path.name.startswith(CACHES))
    if left:
        faults.append(f"temporary files: {left[:3]}")
    if outside:
        faults.append(f"written outside: {outside}")
    if case.kind == "kill" and not faults:
        faults += half_written(work)
    written = sorted(name for name in after if before.get(name) != after[name])
    shutil.rmtree(home, ignore_errors=True)
    lines = [line for line in text.splitlines() if line.startswith("error: ")]
    message = (lines or text.strip().splitlines() or [""])[0].replace(str(work), "…")[:160]
    return Outcome(case.family, case.what, code, round(seconds, 2), message, written[:4], faults)


def _call(case: Any, work: Path, temporary: Path, log: Path) -> tuple[int, list[str]]:
    from querysplat_cli.cli import run

    tempfile.tempdir = str(temporary)
    os.chdir(work)
    signal.alarm(STUCK)
    try:
        with captured(log):
            return int(run(list(case.command))), []
    finally:
        signal.alarm(0)
        os.chdir("/")
        tempfile.tempdir = None


def _process(case: Any, work: Path, temporary: Path, log: Path) -> tuple[int, list[str]]:
    place = case.place
    environment = {**os.environ, "TMPDIR": str(temporary), **place.get("env", {})}
    environment = {key: value for key, value in environment.items() if value is not None}
    command = [*PROGRAM, *case.command]
    if "shell" in place:
        command = ["bash", "-c", place["shell"].format(shlex.join([*PROGRAM, *case.command]))]
    if place.get("alone"):
        command = ["unshare", "--mount", *command]
    user = place.get("user")
    if user is not None:
        for path in (work.parent, *work.parent.rglob("*")):
            os.chown(path, user, user)
        environment["HOME"] = "/nonexistent"
        # The other user can read everything, since Python may be installed where only root can, and write nothing.
        reading = "+dac_read_search"
        who = ("--reuid", str(user), "--regid", str(user), "--clear-groups")
        what = ("--inh-caps", reading, "--ambient-caps", reading, "--bounding-set", f"-all,{reading}")
        command = ["setpriv", *who, *what, *command]
    if "mode" in place:
        for path in (work, *(each for each in work.rglob("*") if each.is_dir())):
            path.chmod(place["mode"])

    def prepare() -> None:
        # `nohup`, and a shell that starts this in the background, let them be ignored.
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
        for name, limit in place.get("limits", {}).items():
            resource.setrlimit(getattr(resource, name), (limit, limit))
        if "cores" in place:
            os.sched_setaffinity(0, list(os.sched_getaffinity(0))[: place["cores"]])

    with log.open("wb") as output:
        process = subprocess.Popen(
            command, cwd=work, env=environment, stdout=output, stderr=output, preexec_fn=prepare, start_new_session=True
        )
        try:
            return place["ending"](process) if "ending" in place else (process.wait(STUCK), [])
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            return 124, []


def _faults(
    case: Any, code: int, seconds: float, text: str, before: dict[str, str], after: dict[str, str]
) -> list[str]:
    faults = []
    if "Traceback" in text:
        faults.append("traceback")
    if code not in case.codes:
        faults.append(f"wrong code {code}")
    quiet = case.kind == "kill" or ">&-" in case.place.get("shell", "") or "|" in case.place.get("shell", "")
    if code in (2, 3, 4) and not quiet and sum(line.startswith("error: ") for line in text.splitlines()) != 1:
        faults.append("no message of one line")
    if code == 124 or (seconds > SLOW and case.kind == "call"):
        faults.append(f"{seconds:.0f} s")
    lost = [name for name in before if after.get(name) != before[name]]
    new = [name for name in after if name not in before]
    allowed = tuple(case.written) if code == 0 or case.kind == "kill" else ()
    touched = [name for name in (*lost, *new) if Path(name).parts[0] not in allowed]
    if touched:
        faults.append(f"touched {touched[:3]}")
    if case.kind == "kill" and any(Path(name).parts[0].startswith(".") for name in after):
        faults.append("a draft was left")
    if case.kind == "kill" and {Path(name).parts[0] for name in before} - {Path(name).parts[0] for name in after}:
        faults.append("something was lost")
    if case.kind == "kill" and any(name not in after and not name.startswith(REPLACED) for name in before):
        faults.append("files were lost")
    return faults
