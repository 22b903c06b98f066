"""The tables and the page of what the cases did."""

from common.output import markdown
from hostile.attempt import Outcome
from hostile.results import Made, Results

SIGNALS = ("INT", "TERM", "HUP", "KILL")


def table(results: Results) -> str:
    """One row for each family."""
    found = results.every
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
        made = f"{results.made[family].commit}, {results.made[family].date}"
        slowest = f"{max(each.seconds for each in some):.1f} s"
        rows.append([family, len(some), clean, *counts, others, codes, slowest, made])
    total = ["**all**", *(sum(row[column] for row in rows) for column in range(1, 7)), "", "", ""]
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
        "commit, day",
    )
    return markdown(head, [*rows, total])


def kill_table(found: list[Outcome]) -> str:
    """One row for each command that is killed."""
    rows = []
    for command in dict.fromkeys(each.what.split(":")[0] for each in found):
        some = [each for each in found if each.what.split(":")[0] == command]
        reached = [each for each in some if each.reached]
        counts = [sum(f": SIG{name} " in each.what for each in reached) for name in SIGNALS]
        instants = [each.instants[-1] for each in reached]
        between = f"{min(instants):.1f} to {max(instants):.1f}" if instants else "–"
        rows.append([f"`{command}`", len(some), len(reached), *counts, _again(some), between])
    total = ["**all**", *(sum(row[column] for row in rows) for column in range(1, 8)), ""]
    return markdown(("command", "kills", "reached it", *SIGNALS, "drawn again", "CPU s at the signal"), [*rows, total])


def _again(kills: list[Outcome]) -> int:
    """How many signals came too late, and were drawn again."""
    return sum(len(each.instants) - 1 for each in kills)


def _on_kills(found: list[Outcome], made: Made) -> str:
    reached = sum(each.reached for each in found)
    return (
        f"Made by `python benchmarks/abuse.py --family kills` at commit {made.commit}, on {made.machine}, other work "
        f"beside, on {made.date}. {reached} of {len(found)} kills ended a command that was running. "
        f"{made.again} of them were not clean at first, and ran again when the package was mended.\n\n"
        "How long each command takes in its situation is measured in the same run, in CPU seconds of it and its "
        "workers. A signal is sent after a share of 95 % of that, which is drawn, half of the times from the second "
        "half. Where the command was done before it came, an earlier instant was drawn: "
        f"{_again(found)} times. What counts is the exit code: 130, 143 and 129 of a command that INT, TERM and HUP "
        "ended, −9 of one that KILL ended; `view`, which serves until Ctrl-C, ends with 0 after INT, and its instants "
        "are seconds by the clock. Every second INT and HUP goes to the workers as "
        "well, as from a terminal. None is sent before the command line is loaded, which takes a fifth of a second: "
        "until then, Python itself ends; and none when the command is done, and Python ends.\n\n"
        "A command that ends as if there had been no signal, or computes for ten seconds after it, is not clean. After "
        "a KILL comes what the next run does first: it sweeps what was left; after the others nothing may be left. "
        "Then every file is read: each must be the old one or the new one, and whole."
    )


def page(results: Results, command: str, intro: str) -> str:
    """The page for docs/. `intro` says what a case is, and when it is clean."""
    found = results.every
    faulty = [each for each in found if each.faults]
    seconds = sum(each.seconds for each in found)
    kills = [each for each in found if each.family == "kills"]
    machines = " and ".join(dict.fromkeys(each.machine for each in results.made.values()))
    days = " and ".join(sorted({each.date for each in results.made.values()}))
    examples = []
    for family in dict.fromkeys(each.family for each in found):
        refused = [each for each in found if each.family == family and each.message and each.code in (2, 3, 4)]
        examples += [
            (each.family, each.what, each.code, each.message) for each in refused[:: max(1, len(refused) // 3)][:3]
        ]
    parts = [
        "# Reliability",
        f"Made by\n\n    {command}\n\non {machines}, other work beside, on {days}, in {seconds / 60:.0f} minutes of "
        "the cases' own time. It was run in parts, which `--family` chose and `--read` joined; the table says of which "
        f"commit each part is. {len(found) - len(faulty):,} of {len(found):,} cases are clean.",
        intro.replace("\n", " "),
        table(results),
        "Every case with its message, exit code, time and files is in `benchmarks/results/abuse.json`.",
        "## Kills",
        _on_kills(kills, results.made["kills"]),
        kill_table(kills),
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
