"""The table and the page of what the cases did."""

from datetime import date

from common.output import machine, markdown
from hostile.attempt import Outcome


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


def page(found: list[Outcome], command: str, intro: str) -> str:
    """The page for docs/. `intro` says what a case is, and when it is clean."""
    faulty = [each for each in found if each.faults]
    seconds = sum(each.seconds for each in found)
    kills = [each for each in found if each.family == "kills"]
    done = sum(each.code == 0 for each in kills)
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
        "A signal is sent to each of 21 commands six times for each of four signals, half of the times in the second "
        f"half of its computing. {done} of these {len(kills)} runs were done before it came, or had written their "
        f"result, and ended with exit code 0; {len(kills) - done} were ended by it. "
        "None is ended in its first 0.8 CPU seconds, in which Python itself "
        "starts. After a kill comes what the next run does first: it sweeps what was left. Then every file is read: "
        "each must be the old one or the new one, and whole. Every case with its message, exit code, time and files "
        "is in `benchmarks/results/abuse.json`.",
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
