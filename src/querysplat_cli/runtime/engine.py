"""What carries out the tasks of a long run. A task is a folder: its input is there, and its output goes there.

A task is idempotent. Done once more, it gives the same output, and one whose output is there does nothing. So a task
whose process was killed is simply done again, by whichever engine.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

from querysplat_cli.runtime.progress import Progress, Stages

Work = Callable[[Path, Progress], None]
"""Does the task in a folder. It is a function of a module, so that other processes can import it."""


class Engine(Protocol):
    """Runs tasks."""

    def run(self, work: Work, folders: Sequence[Path], stages: Stages) -> None:
        """Do the tasks in all `folders`; each is a stage of the name of its folder.

        Raises what a task raises, after the tasks that are under way have ended or were stopped.
        """
        ...


class InProcess:
    """One task after another, in this process."""

    def run(self, work: Work, folders: Sequence[Path], stages: Stages) -> None:
        for folder in folders:
            with stages(folder.name) as progress:
                work(folder, progress)
