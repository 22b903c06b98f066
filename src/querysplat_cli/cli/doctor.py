"""`querysplat doctor`: what this machine and this installation can do."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

from querysplat_cli.cli.verb import Printing
from querysplat_cli.runtime.errors import MissingPart


@dataclass(frozen=True)
class DoctorRequest:
    """Nothing can be chosen."""


def doctor(request: DoctorRequest, printing: Printing) -> None:
    """Look at this machine and this installation: what works, what is missing, and the command that brings it.

    Nothing is written or fetched. The exit code is 4 where something needed is missing.
    """
    from querysplat_cli.cli.terminal import print_json, rows_table, say
    from querysplat_cli.commands.doctor import diagnose

    found = diagnose()
    print_json(asdict(found), printing)
    say(rows_table(f"querysplat {found.querysplat}", list(_rows(found))), printing)
    say(rows_table("optional parts", [(part.extra, _part(part)) for part in found.optional]), printing)
    if found.problems:
        raise MissingPart("; ".join(found.problems), "`querysplat doctor --json` has all of it, for a bug report.")
    say("all that is needed is here; next: querysplat demo, or querysplat reconstruct photos/", printing)


def _rows(found: Any) -> Iterator[tuple[str, str]]:
    from querysplat_cli.commands.doctor import TESTED_PYTHON, tested_python

    yield "installed in", found.package
    yield "machine", found.machine
    if not tested_python():
        yield "", f"the tests ran with Python {' to '.join(dict.fromkeys(TESTED_PYTHON))}"
    yield "memory", f"{found.memory_gib} GiB, {found.free_memory_gib} free"
    yield "temporary files", f"{found.temporary or 'nowhere'}, {found.free_disk_gib} GiB free"
    rest = "" if found.compiled == found.kernels else "; the first scene compiles the others, about half a minute"
    yield "compiled", f"{found.compiled} of {found.kernels} kernels{rest}"
    yield "encoders", ", ".join(found.encoders)
    yield "splatters", ", ".join(found.splatters)
    yield "devices", ", ".join(found.devices)
    if "cuda" not in found.devices:
        yield "", f"no cuda: {found.cuda}"
    else:
        yield "", found.cuda


def _part(part: Any) -> str:
    return f"{part.version}: {part.gives}" if part.version else f"not here. {part.command} brings {part.gives}"
