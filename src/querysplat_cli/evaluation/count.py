"""How much an evaluation has to do, and how much of it is done."""

from collections.abc import Sequence

from querysplat_cli.evaluation.plan import Job
from querysplat_cli.runtime.progress import Progress
from querysplat_cli.runtime.words import counted

MANY_SCENES = 100
"""With more scenes to make, the message says how to make fewer."""


def to_do(jobs: Sequence[Job], splits: int, workers: int) -> str:
    """What is to be done, before it begins."""
    scenes = sum(len(job.rows) for job in jobs)
    cases = f"{counted(len(jobs), 'case')} of {counted(splits, 'split')}"
    text = f"{cases}, {counted(scenes, 'scene')} to make, {workers} at a time"
    return f"{text}; --cases N takes N cases of each split" if scenes > MANY_SCENES else text


class Counter:
    """Counts scenes, of which a case has one for each row, and passes the count on to `progress`."""

    def __init__(self, jobs: Sequence[Job], progress: Progress) -> None:
        self._progress = progress
        self._scenes = sum(len(job.rows) for job in jobs)
        self._made: dict[tuple[str, str], int] = {}

    def heard(self, job: Job, text: str, fraction: float) -> None:
        """A worker begins with the row `text` of a case, of whose rows this fraction is done."""
        self._count(job, round(fraction * len(job.rows)), f", {text}")

    def done(self, job: Job) -> None:
        """All rows of a case are done."""
        self._count(job, len(job.rows), "")

    def _count(self, job: Job, made: int, row: str) -> None:
        self._made[job.split, job.case.name] = made
        total = sum(self._made.values())
        self._progress(f"{total:,} of {self._scenes:,} scenes: {job.split}, {job.case.name}{row}", total / self._scenes)
