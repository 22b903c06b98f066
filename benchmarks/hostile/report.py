"""The tables and the page of what the cases did."""

import textwrap
from collections import Counter
from collections.abc import Iterator

from common.output import markdown
from hostile.attempt import Outcome
from hostile.results import Made, Results

SIGNALS = ("INT", "TERM", "HUP", "KILL")
LONG_TEXT = "2d97bb6"
"""The last commit whose page has a column for each kind of fault, and three messages of every family."""
ASPECTS = {
    "Gaussians in files": ("PLY", "PLY by hypothesis", "SPZ", "SOG", "glTF", ".lod"),
    "Cameras in files": (
        "transforms.json", "JSON by hypothesis", "cameras.json", "cameras.json, rendered", "COLMAP, text",
        "COLMAP, binary",
    ),
    "Photos": ("pictures", "EXIF", "films", "masks", "GPS"),
    "Files of a scene's folder": (
        "memories", "report.json", "photos.json", "exposures.json", "points.safetensors", "a scene's pictures",
        "damaged scenes, shown",
    ),
    "Training and scoring": ("weights", "TOML", "split files", "zips", "results of eval"),
    "Commands and machines": ("options", "places", "kills"),
}  # fmt: skip
"""What a reader asks for, and the families that tell it."""
OVERVIEW = """| question | in short |
| --- | --- |
| [What do damaged files and bad options do?](#inputs) | exit code 2 and no change, or a result |
| [What does a bad place do?](#inputs) | a full disk ends a command with 2, too little memory with 4 |
| [What does a kill leave?](#kills) | each file is the old one or the new one, and whole; the next run sweeps the rest |
| [Which cases are not clean?](#cases-that-are-not-clean) | {faulty} |
| [What do messages say?](#what-the-messages-are-like) | the file and the fault |

*Places* are full disks and full folders of temporary files, limits of memory, of open files and of the size of files,
folders that cannot be written or vanish, homes that are missing, and closed outputs. [The command
line](cli.md#exit-codes) says what exit codes mean."""
DRAWN = """Most cases are sound files with bytes or values changed, or cut off.
*By hypothesis* are files that the library of that name draws. *Rendered* cameras go to `render`. *Damaged scenes,
shown* are scenes that `info`, `export`, `inspect`, `poses`, `convert` and `render` read."""
EVERYDAY = ("Photos", "Commands and machines")
"""Aspects of which a page shows three messages for each family, and not one."""


def ordered(families: list[str]) -> Iterator[tuple[str, list[str]]]:
    """The families of each aspect; those of none come last."""
    rest = [each for each in families if not any(each in some for some in ASPECTS.values())]
    for aspect, some in {**ASPECTS, "Others": rest}.items():
        if chosen := [each for each in some if each in families]:
            yield aspect, chosen


def usual(results: Results) -> str:
    """The commit and the day of most families."""
    return Counter(f"{each.commit}, {each.date}" for each in results.made.values()).most_common(1)[0][0]


def table(results: Results) -> str:
    """One row for each family. Where it was made when most were, the last cell is empty."""
    found, rows, most = results.every, [], usual(results)
    for aspect, families in ordered(list(dict.fromkeys(each.family for each in found))):
        rows.append([f"**{aspect}**", *[""] * 5])
        for family in families:
            some = [each for each in found if each.family == family]
            counts = Counter(each.code for each in some)
            codes = ", ".join(f"{code}: {counts[code]}" for code in sorted(counts))
            clean = sum(not each.faults for each in some)
            made = f"{results.made[family].commit}, {results.made[family].date}"
            slowest = f"{max(each.seconds for each in some):.1f} s"
            rows.append([family, len(some), clean, codes, slowest, "" if made == most else made])
    total = ["**all**", len(found), sum(not each.faults for each in found), "", "", ""]
    return markdown(("inputs", "number", "clean", "exit codes", "slowest", "commit, day"), [*rows, total])


def kill_table(found: list[Outcome]) -> str:
    """One row for each command that is killed."""
    rows = []
    for command in dict.fromkeys(each.what.split(":")[0] for each in found):
        some = [each for each in found if each.what.split(":")[0] == command]
        reached = [each for each in some if each.reached]
        instants = [each.instants[-1] for each in reached]
        between = f"{min(instants):.1f} to {max(instants):.1f}" if instants else "–"
        rows.append([f"`{command}`", len(some), _by_signal(reached), between])
    total = ["**all**", len(found), _by_signal([each for each in found if each.reached]), ""]
    signals = f"reached by {', '.join(SIGNALS)}"
    return markdown(("command", "kills", signals, "CPU s at the signal"), [*rows, total])


def _by_signal(kills: list[Outcome]) -> str:
    """How many of the kills each signal made."""
    counts = [str(sum(f": SIG{name} " in each.what for each in kills)) for name in SIGNALS]
    return f"{counts[0]} each" if len(set(counts)) == 1 else ", ".join(counts)


def _again(kills: list[Outcome]) -> int:
    """How many signals came too late, and were drawn again."""
    return sum(len(each.instants) - 1 for each in kills)


def _wrapped(paragraphs: str) -> str:
    """Paragraphs in lines of at most 120 characters."""
    return "\n\n".join(textwrap.fill(each, 120, break_on_hyphens=False) for each in paragraphs.split("\n\n"))


def _on_kills(found: list[Outcome], made: Made) -> str:
    reached = sum(each.reached for each in found)
    return (
        f"Made by `python benchmarks/abuse.py --family kills` at commit {made.commit}, on {made.machine}, other work "
        f"beside, on {made.date}. {reached} of {len(found)} kills ended a command that was running. "
        f"{made.again or 'None'} of them were not clean at first, and ran again when the package was mended.\n\n"
        "**What must hold.** The exit code is 130, 143 or 129 after INT, TERM or HUP, and −9 after KILL. `view` serves "
        "until Ctrl-C, and ends with 0 after INT. The command does not end as if there had been no signal, nor compute "
        "for ten seconds after it. After a KILL comes what the next run does first: it sweeps what was left. After the "
        "others nothing may be left. Then every file is read: each must be the old one or the new one, and whole.\n\n"
        "**When signals come.** Each command's CPU seconds, with its workers', are measured first; of `view`, seconds "
        "by the clock. A signal comes after a drawn share of 95 % of them, half of the times from the second half. "
        f"Where the command was done before, an earlier instant was drawn: {_again(found)} times. "
        "Every second INT and HUP goes to the workers as well, as from a terminal. None is sent in the first fifth of "
        "a second, before the command line is loaded, or when the command is done: there Python itself ends."
    )


def page(results: Results, command: str, intro: str) -> str:
    """The page for docs/. `intro` says what a case is, and when it is clean."""
    found = results.every
    faulty = [each for each in found if each.faults]
    seconds = sum(each.seconds for each in found)
    kills = [each for each in found if each.family == "kills"]
    machines = " and ".join(dict.fromkeys(each.machine for each in results.made.values()))
    days = " and ".join(sorted({each.date for each in results.made.values()}))
    parts = [
        "# Reliability",
        _wrapped(
            "Damaged files, extreme options, bad places and kills: what does the command line make of them? "
            f"{len(found) - len(faulty):,} of {len(found):,} cases are clean. Commit {LONG_TEXT} is the last one with "
            f"the long text of this page (`git show {LONG_TEXT}:docs/reliability.md`)."
        ),
        OVERVIEW.format(faulty=len(faulty) or "none"),
        f"**How it was made.** By\n\n    {command}",
        _wrapped(
            f"on {machines}, other work beside, on {days}, in {seconds / 60:.0f} minutes of the cases' own time. It "
            "was run in parts, which `--family` chose and `--read` joined. Every case with its message, exit code, "
            "time and files is in `benchmarks/results/abuse.json`."
        ),
        intro,
        "## Inputs",
        _wrapped(f"Made at {usual(results)}, where a row says nothing else. {DRAWN}"),
        table(results),
        "## Kills",
        _wrapped(_on_kills(kills, results.made["kills"])),
        kill_table(kills),
        "## Cases that are not clean",
        markdown(("inputs", "case", "faults"), [(e.family, f"`{e.what}`", "; ".join(e.faults)) for e in faulty])
        if faulty
        else "None.",
        "## What the messages are like",
        "The exit code is 2 where the case does not say another.",
        markdown(
            ("inputs", "case", "message"),
            [
                (e.family, f"`{e.what}`" + f" ({e.code})" * (e.code != 2), f"`{e.message.removeprefix('error: ')}`")
                for e in _examples(found)
            ],
        ).replace("\\", "\\\\"),
    ]
    return "\n\n".join(parts) + "\n"


def _examples(found: list[Outcome]) -> Iterator[Outcome]:
    """Refusals of each family, from far apart, whose messages differ."""
    for aspect, families in ordered(list(dict.fromkeys(each.family for each in found))):
        for family in families:
            refused = [each for each in found if each.family == family and each.message and each.code in (2, 3, 4)]
            apart = refused[:: max(1, len(refused) // 3)][:3]
            differ = list({each.message: each for each in reversed(apart)}.values())[::-1]
            yield from differ[: 3 if aspect in EVERYDAY else 1]
