"""Hostile inputs: what the command line makes of damaged files, extreme options, bad places and kills.

    python benchmarks/abuse.py [--write docs/reliability.md] [--json benchmarks/results/abuse.json] [--family NAME ...]

Every case runs in an empty folder of its own. Afterwards the message, the exit code, the time and the files are
compared with what they should be. A case is clean if there is no traceback, the exit code is one of those that are
right, a failure is one line with a hint, a failure left nothing new, nothing of the user's was lost, no temporary file
was left, and nothing outside the folder was touched. Places and kills are commands in a process of their own; every
other case runs in one process whose kernels are loaded, and may take 10 seconds there. The slowest place is a user
without a home directory, for whom every kernel is compiled anew. The exit code is 1 if a case is not clean.
"""

import argparse
import contextlib
import hashlib
import json
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
from dataclasses import asdict, dataclass
from datetime import date
from pathlib import Path
from typing import Any

import psutil

from common.output import machine, markdown

SLOW = 10.0
STUCK = 240.0
"""Seconds after which a case is ended."""
CACHES = ("torchinductor_", "querysplat-cache-")
"""Temporary folders that serve all runs: torch's, and the one of users without a home directory."""
MOST_MEMORY = 8 << 30
"""The address space of the process of the cases. A case that wants more fails by that, and not by the machine's end."""
PROGRAM = (sys.executable, "-m", "querysplat_cli")


@dataclass(frozen=True)
class Outcome:
    """What a case did. `faults` names what is not clean."""

    family: str
    what: str
    code: int
    seconds: float
    message: str
    written: list[str]
    faults: list[str]


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
    home = Path(tempfile.mkdtemp(dir=scratch))
    work, temporary, log = home / "work", home / "tmp", home / "log"
    work.mkdir()
    temporary.mkdir()
    case.make(work)
    before = snapshot(work)
    started = time.perf_counter()
    code = (_call if case.kind == "call" else _process)(case, work, temporary, log)
    seconds = time.perf_counter() - started
    text = log.read_text(errors="replace")
    if case.kind == "kill":
        _next_run(work, temporary)
    after = snapshot(work)
    outside = [path.name for path in home.iterdir() if path.name not in ("work", "tmp", "log")]
    faults = _faults(case, code, seconds, text, before, after)
    left = sorted(path.name for path in temporary.iterdir() if not path.name.startswith(CACHES))
    if left:
        faults.append(f"temporary files: {left[:3]}")
    if outside:
        faults.append(f"written outside: {outside}")
    if case.kind == "kill" and not faults:
        faults += _readable(work)
    written = sorted(name for name in after if before.get(name) != after[name])
    shutil.rmtree(home, ignore_errors=True)
    lines = [line for line in text.splitlines() if line.startswith("error: ")]
    message = (lines or text.strip().splitlines() or [""])[0].replace(str(work), "…")[:160]
    return Outcome(case.family, case.what, code, round(seconds, 2), message, written[:4], faults)


def _call(case: Any, work: Path, temporary: Path, log: Path) -> int:
    from querysplat_cli.cli import run

    tempfile.tempdir = str(temporary)
    os.chdir(work)
    try:
        with captured(log):
            return int(run(list(case.command)))
    finally:
        os.chdir("/")
        tempfile.tempdir = None


def _process(case: Any, work: Path, temporary: Path, log: Path) -> int:
    place = case.place
    environment = {**os.environ, "TMPDIR": str(temporary), **place.get("env", {})}
    environment = {key: value for key, value in environment.items() if value is not None}
    command = [*PROGRAM, *case.command]
    if "shell" in place:
        command = ["bash", "-c", place["shell"].format(shlex.join([*PROGRAM, *case.command]))]
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
            if "signal" in place:
                _compute(process, place["seconds"])
                if process.poll() is None:
                    process.send_signal(place["signal"])
            return process.wait(STUCK)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            return 124


def _compute(process: "subprocess.Popen[bytes]", seconds: float) -> None:
    """Return when the process has computed for so long, on all cores together, or has ended or got stuck."""
    end = time.perf_counter() + STUCK
    with contextlib.suppress(psutil.NoSuchProcess):
        watched = psutil.Process(process.pid)
        while process.poll() is None and time.perf_counter() < end:
            spent = watched.cpu_times()
            if spent.user + spent.system >= seconds:
                return
            time.sleep(0.01)


def _next_run(work: Path, temporary: Path) -> None:
    """What the next run does before its work: sweep what a kill left, here and among the temporary files."""
    from querysplat_cli.scene.drafts import SCRATCH, sweep
    from querysplat_cli.scene.files import check_writable

    for folder in (work, *(path for path in work.iterdir() if path.is_dir())):
        check_writable(folder)
    sweep(temporary, SCRATCH)


def _readable(work: Path) -> list[str]:
    """Faults of the scenes after a kill: each is the old one or the new one, and whole."""
    from querysplat_cli.pipeline.read_scene import read_scene
    from querysplat_cli.runtime.errors import QuerySplatError
    from querysplat_cli.scene.formats.ply import read_ply

    faults = []
    for ply in work.rglob("*.ply"):
        try:
            read_ply(ply)
            if ply.with_suffix("").is_dir():
                read_scene(ply)
        except QuerySplatError as error:
            faults.append(f"half-written: {error}")
    return faults


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
    if case.kind == "kill" and any(name not in after for name in before):
        faults.append("something was lost")
    return faults


def warm_up(sound: Any, folder: Path) -> None:
    """Load what the first case would have to wait for."""
    from querysplat_cli.cli import run

    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    sound.scene(folder)
    run(["tto", str(folder / "s"), "--steps", "1", "-q"])


def serve(folder: Path, options: argparse.Namespace) -> None:
    """Run the cases from number `options.start` on. Each outcome is a line of JSON on the original standard output."""
    from abuse_cases import all_cases
    from abuse_inputs import Sound

    resource.setrlimit(resource.RLIMIT_AS, (MOST_MEMORY, resource.RLIM_INFINITY))
    results = os.fdopen(os.dup(1), "w")
    sound = object.__new__(Sound)
    sound.folder, sound.photos, sound.captured = folder, folder / "photos", folder / "captured"
    with captured(folder / "log"):
        warm_up(sound, folder / "warm")
    every = (case for case in all_cases(sound, options.kills) if options.only in case.what)
    chosen = [case for case in every if not options.family or case.family in options.family]
    for case in chosen[options.start :]:
        print(json.dumps({"starts": case.what, "family": case.family}), file=results, flush=True)
        print(json.dumps(asdict(attempt(case, folder / "scratch"))), file=results, flush=True)
    print(json.dumps({"end": True}), file=results, flush=True)


def outcomes(folder: Path, options: argparse.Namespace) -> list[Outcome]:
    """All outcomes until the time is over. The cases run in one process, which is started again after a case that
    crashes it or gets stuck.
    """
    found: list[Outcome] = []
    end = time.perf_counter() + options.minutes * 60
    while True:
        chosen = ["--only", options.only, "--kills", str(options.kills), "--family", *options.family]
        start = str(options.start + len(found))
        command = [sys.executable, __file__, "--serve", str(folder), "--start", start, *chosen]
        environment = {**os.environ, "PYTHONWARNINGS": "ignore"}
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as process:
            assert process.stdout is not None
            current = None
            for line in process.stdout:
                entry = json.loads(line)
                if entry.get("end"):
                    return found
                if "starts" in entry:
                    current = entry
                    continue
                found.append(Outcome(**entry))
                current = None
                if found[-1].faults:
                    print(found[-1], file=sys.stderr, flush=True)
                if time.perf_counter() > end:
                    process.terminate()
                    return found
            code = process.wait()
        if current is None:
            raise SystemExit(f"the process of the cases ended with {code}")
        found.append(Outcome(current["family"], current["starts"], code, 0.0, "", [], [f"crash {code}"]))
        print(found[-1], file=sys.stderr, flush=True)


def table(found: list[Outcome]) -> str:
    """One row for each family."""
    rows = []
    for family in dict.fromkeys(each.family for each in found):
        some = [each for each in found if each.family == family]
        faults = [fault for each in some for fault in each.faults]
        counts = [sum(fault.startswith(start) for fault in faults) for start in ("traceback", "wrong code", "crash")]
        others = len(faults) - sum(counts)
        codes = ", ".join(
            f"{code}: {sum(each.code == code for each in some)}" for code in sorted({e.code for e in some})
        )
        clean = sum(not each.faults for each in some)
        rows.append([family, len(some), clean, *counts, others, codes, f"{max(each.seconds for each in some):.1f} s"])
    total = ["**all**", *(sum(row[column] for row in rows) for column in range(1, 7)), "", ""]
    head = (
        "inputs",
        "number",
        "clean",
        "tracebacks",
        "wrong codes",
        "crashes",
        "other faults",
        "exit codes",
        "slowest",
    )
    return markdown(head, [*rows, total])


def page(found: list[Outcome], command: str, seconds: float) -> str:
    """The page for docs/."""
    faulty = [each for each in found if each.faults]
    intro = __doc__.split("\n\n", 2)[2].strip()
    examples = []
    for family in dict.fromkeys(each.family for each in found):
        refused = [each for each in found if each.family == family and each.message and each.code in (2, 3, 4)]
        examples += [
            (each.family, each.what, each.code, each.message) for each in refused[:: max(1, len(refused) // 3)][:3]
        ]
    parts = [
        "# Reliability",
        f"Made by\n\n    {command}\n\non {machine()}, other work beside, on {date.today()}, in {seconds / 60:.0f} "
        f"minutes of the cases' own time. It was run in parts, which `--family` chose and `--read` joined. "
        f"{len(found) - len(faulty):,} of {len(found):,} cases are clean.",
        intro.replace("\n", " "),
        table(found),
        "After a kill comes what the next run does first: it sweeps what was left. No command is killed in its first "
        "0.8 seconds, in which Python itself starts. Seconds of kills are those that the command computed where their "
        "name says CPU, and those of the clock elsewhere. Every case with its message, exit code, time and files is in "
        "`benchmarks/results/abuse.json`.",
        "## Cases that are not clean",
        markdown(("inputs", "case", "faults"), [(e.family, f"`{e.what}`", "; ".join(e.faults)) for e in faulty])
        if faulty
        else "None.",
        "## What the messages are like",
        markdown(
            ("inputs", "case", "exit code", "message"),
            [(f, f"`{w}`", c, f"`{m.removeprefix('error: ')}`") for f, w, c, m in examples],
        ).replace("\\", "\\\\"),
    ]
    return "\n\n".join(parts) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--write", type=Path, help="write the page here")
    parser.add_argument("--json", type=Path, help="write every outcome here")
    parser.add_argument(
        "--read", type=Path, nargs="*", default=[], help="take the outcomes from these files, later ones first"
    )
    parser.add_argument("--only", default="", help="only cases with this text in their description")
    parser.add_argument("--family", nargs="*", default=[], help="only these families")
    parser.add_argument("--serve", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--kills", type=int, default=16, help="how often each signal kills each of eight commands")
    parser.add_argument("--start", type=int, default=0, help="leave out so many of the chosen cases")
    parser.add_argument("--minutes", type=float, default=1e6, help="begin no case after so many minutes")
    options = parser.parse_args()
    if options.serve:
        serve(options.serve, options)
        return
    if options.read:
        every = [Outcome(**each) for file in options.read for each in json.loads(file.read_text())]
        found = list({(each.family, each.what): each for each in every}.values())
        report(found, options, sum(each.seconds for each in found))
    started = time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="abuse-") as scratch:
        folder = Path(scratch)
        folder.chmod(0o755)
        (folder / "scratch").mkdir()
        (folder / "scratch").chmod(0o777)
        prepare = f"from abuse_inputs import Sound; from pathlib import Path; Sound(Path({scratch!r}))"
        subprocess.run([sys.executable, "-c", prepare], cwd=Path(__file__).parent, check=True)
        found = outcomes(folder, options)
    report(found, options, time.perf_counter() - started)


def report(found: list[Outcome], options: argparse.Namespace, seconds: float) -> None:
    """Write what was asked for, print the table, and exit."""
    faulty = sum(bool(each.faults) for each in found)
    if options.json:
        options.json.write_text(json.dumps([asdict(each) for each in found], indent=0) + "\n")
    if options.write:
        command = "python benchmarks/abuse.py --write docs/reliability.md --json benchmarks/results/abuse.json"
        options.write.write_text(page(found, command, seconds))
    print(table(found))
    print(f"{len(found) - faulty} of {len(found)} cases are clean", file=sys.stderr)
    sys.exit(faulty > 0)


if __name__ == "__main__":
    main()
