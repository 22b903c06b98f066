"""The file of outcomes, in which it stands when those of each family were made."""

import json
import subprocess
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import date
from pathlib import Path

from common.output import machine
from hostile.attempt import Outcome

OF_KILLS = ("reached", "instants")
"""Fields that are left out where they say nothing."""


@dataclass(frozen=True)
class Made:
    """When and where the outcomes of a family were made; several commits where one run went on with another.

    `again` counts cases that were not clean and ran again, when the package was mended.
    """

    commit: str
    date: str
    machine: str
    again: int = 0


@dataclass(frozen=True)
class Results:
    """Outcomes by family and description, and how those of each family were made."""

    outcomes: dict[tuple[str, str], Outcome] = field(default_factory=dict)
    made: dict[str, Made] = field(default_factory=dict)

    @property
    def every(self) -> list[Outcome]:
        return list(self.outcomes.values())

    def add(self, found: Iterable[Outcome]) -> None:
        """Add outcomes of now; they take the places of those with the same description."""
        now = made_now()
        for outcome in found:
            key = outcome.family, outcome.what
            again = int(key in self.outcomes and bool(self.outcomes[key].faults))
            self.outcomes[key] = outcome
            self.made[outcome.family] = _joined(self.made.get(outcome.family, now), replace(now, again=again))


def made_now() -> Made:
    """This commit, with a plus sign where files differ from it; this day; and this machine."""
    describe = ("git", "describe", "--always", "--dirty=+", "--exclude=*")
    commit = subprocess.run(describe, cwd=Path(__file__).parent, check=True, capture_output=True, text=True).stdout
    return Made(commit.strip(), str(date.today()), machine())


def read(files: Sequence[Path]) -> Results:
    """What is in these files. A family of a later file takes the place of that of another commit.

    With a commit in common they are joined, and later outcomes take the places of those with the same description.
    """
    results = Results()
    for content in (json.loads(file.read_text()) for file in files if file.exists()):
        for family, entry in content["made"].items():
            made = Made(**entry)
            before = results.made.get(family, made)
            if not set(before.commit.split(", ")) & set(made.commit.split(", ")):
                for key in [key for key in results.outcomes if key[0] == family]:
                    del results.outcomes[key]
                del results.made[family]
            results.made[family] = _joined(before, made) if family in results.made else made
        for each in content["outcomes"]:
            results.outcomes[each["family"], each["what"]] = Outcome(**each)
    return results


def _joined(before: Made, after: Made) -> Made:
    commits = dict.fromkeys([*before.commit.split(", "), *after.commit.split(", ")])
    return Made(", ".join(commits), after.date, after.machine, before.again + after.again)


def write(file: Path, results: Results) -> None:
    """Write every outcome, a field a line."""
    outcomes = [asdict(each) for each in results.every]
    shown = [{key: value for key, value in each.items() if value or key not in OF_KILLS} for each in outcomes]
    made = {family: asdict(each) for family, each in results.made.items()}
    file.write_text(json.dumps({"made": made, "outcomes": shown}, indent=0) + "\n")
