"""Hostile inputs: what the command line makes of damaged files, extreme options, bad places and kills.

    python benchmarks/abuse.py [--write docs/reliability.md] [--json benchmarks/results/abuse.json] [--family NAME ...]

Every case runs in an empty folder of its own. Afterwards the message, the exit code, the time and the files are
compared with what they should be. A case is clean if

- there is no traceback, and the exit code is one of those that are right;
- a failure is one line with a hint, and left nothing new;
- nothing of the user's was lost, no temporary file was left, and nothing outside the folder was touched.

Caches of compiled code serve all runs and are no temporary files: torch's `torchinductor_USER`, and
`querysplat-cache-USER` of a user without a home directory. Places and kills are commands in a process of their own;
every other case runs in one process whose kernels are loaded, and may compute for 10 seconds there. The slowest place
is a user without a home directory, for whom every kernel is compiled anew. The program's exit code is 1 if a case is
not clean.
"""

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from hostile.attempt import Outcome, attempt, captured
from hostile.killing import Length, attempt_kill
from hostile.report import page, table
from hostile.results import Results, read, write

if TYPE_CHECKING:
    from hostile.sound import Sound

MOST_MEMORY = 8 << 30
"""The address space of the process of the cases. A case that wants more fails by that, and not by the machine's end."""


def serve(folder: Path, options: argparse.Namespace) -> None:
    """Run the cases from number `options.start` on. Each outcome is a line of JSON on the original standard output."""
    from hostile.families import all_cases
    from hostile.sound import Sound

    resource.setrlimit(resource.RLIMIT_AS, (MOST_MEMORY, resource.RLIM_INFINITY))
    results = os.fdopen(os.dup(1), "w")
    sound = Sound(folder)
    known = read(options.read).outcomes if options.resume else {}
    done = {key for key, each in known.items() if not each.faults}
    every = (case for case in all_cases(sound) if any(text in case.what for text in options.only))
    some = (case for case in every if not options.family or case.family in options.family)
    chosen = [case for case in some if (case.family, case.what) not in done]
    if any(case.kind == "call" for case in chosen):
        with captured(folder / "log"):
            warm_up(sound, folder / "warm")
    lengths: dict[str, Length] = {}
    for case in chosen[options.start :]:
        print(json.dumps({"starts": case.what, "family": case.family}), file=results, flush=True)
        scratch = folder / "scratch"
        outcome = attempt_kill(case, scratch, lengths) if case.kind == "kill" else attempt(case, scratch)
        print(json.dumps(asdict(outcome)), file=results, flush=True)
    print(json.dumps({"end": True}), file=results, flush=True)


def warm_up(sound: "Sound", folder: Path) -> None:
    """Load what the first case would have to wait for."""
    from querysplat_cli.cli import run

    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    sound.scene(folder)
    run(["tto", str(folder / "s"), "--steps", "1", "-q"])


def outcomes(folder: Path, arguments: list[str]) -> Iterator[Outcome]:
    """The outcome of each case. The cases run in one process, which is started again after one that crashes it."""
    count = 0
    while True:
        command = [sys.executable, __file__, *arguments, "--serve", str(folder), "--start", str(count)]
        environment = {**os.environ, "PYTHONWARNINGS": "ignore"}
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as process:
            assert process.stdout is not None
            current = None
            try:
                for line in process.stdout:
                    entry = json.loads(line)
                    if entry.get("end"):
                        return
                    if "starts" in entry:
                        current = entry
                        continue
                    count, current = count + 1, None
                    yield Outcome(**entry)
            finally:
                process.terminate()
        if current is None:
            raise SystemExit(f"the process of the cases ended with {process.returncode}")
        count += 1
        code = process.returncode
        yield Outcome(current["family"], current["starts"], code, 0.0, "", [], [f"crash {code}"])


def parsed() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--write", type=Path, help="write the page here")
    parser.add_argument("--json", type=Path, help="write every outcome here")
    parser.add_argument(
        "--read", type=Path, nargs="*", default=[],
        help="join the outcomes in these files; a family of a later file takes the place of that of another commit",
    )  # fmt: skip
    parser.add_argument(
        "--resume", action="store_true", help="run the cases that --read does not have, or has with faults"
    )
    parser.add_argument("--only", nargs="*", default=[""], help="only cases with one of these in their description")
    parser.add_argument("--family", nargs="*", default=[], help="only these families")
    parser.add_argument("--sound", type=Path, help="keep the sound files in this folder, for the next time")
    parser.add_argument("--minutes", type=float, default=1e6, help="begin no case after so many minutes")
    parser.add_argument("--serve", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--start", type=int, default=0, help=argparse.SUPPRESS)
    return parser.parse_args()


def main() -> None:
    options = parsed()
    if options.serve:
        serve(options.serve, options)
        return
    results = read(options.read)
    if options.resume or not options.read:
        results.add(run_cases(options))
    report(results, options)


def run_cases(options: argparse.Namespace) -> list[Outcome]:
    """Run the chosen cases until the time is over. Cases that are not clean are printed at once."""
    found: list[Outcome] = []
    end = time.perf_counter() + options.minutes * 60
    with tempfile.TemporaryDirectory(prefix="abuse-") as scratch:
        folder = options.sound or Path(scratch)
        if not (folder / "scratch").exists():
            prepare = f"from hostile.sound import make; from pathlib import Path; make(Path({str(folder)!r}))"
            subprocess.run([sys.executable, "-c", prepare], cwd=Path(__file__).parent, check=True)
            folder.chmod(0o755)
            (folder / "scratch").mkdir()
            (folder / "scratch").chmod(0o777)
        for outcome in outcomes(folder, sys.argv[1:]):
            found.append(outcome)
            if outcome.faults:
                print(outcome, file=sys.stderr, flush=True)
            if time.perf_counter() > end:
                break
    return found


def report(results: Results, options: argparse.Namespace) -> None:
    """Write what was asked for, print the table, and exit."""
    found = results.every
    faulty = sum(bool(each.faults) for each in found)
    if options.json:
        write(options.json, results)
    if options.write:
        command = "python benchmarks/abuse.py --write docs/reliability.md --json benchmarks/results/abuse.json"
        options.write.write_text(page(results, command, __doc__.split("\n\n", 2)[2].strip()))
    print(table(results))
    print(f"{len(found) - faulty} of {len(found)} cases are clean", file=sys.stderr)
    sys.exit(faulty > 0)


if __name__ == "__main__":
    main()
