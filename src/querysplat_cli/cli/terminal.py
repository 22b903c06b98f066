"""Where output goes: progress and tables to standard error, results for programs to standard output."""

import json
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console, RenderableType
from rich.progress import BarColumn, Progress, SpinnerColumn, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Table

from querysplat_cli.cli.verb import Printing
from querysplat_cli.runtime.progress import Stages

console = Console(stderr=True, highlight=False)


def say(text: RenderableType, printing: Printing) -> None:
    """Print for people, unless --quiet."""
    if not printing.quiet:
        console.print(text)


def print_json(result: Any, printing: Printing) -> None:
    """Print for programs, if --json."""
    if printing.json:
        print(json.dumps(result, indent=2))


def rows_table(title: str, rows: Iterable[tuple[str, str]], *, indent: int = 0) -> Table:
    """Two columns without borders: names and what they are."""
    table = Table(title=title, title_justify="left", show_header=False, box=None, padding=(0, 2, 0, indent))
    table.add_column()
    table.add_column(overflow="fold")
    for name, text in rows:
        table.add_row(name, text)
    return table


@contextmanager
def showing_stages(printing: Printing, *, started: float | None = None) -> Iterator[Stages]:
    """Stages whose progress is drawn on a terminal, and printed line by line elsewhere; nothing with --quiet.

    `started` is when the command began, by `time.perf_counter`; now by default.
    """
    if printing.quiet:
        yield Stages(started=started)
    elif not console.is_terminal:
        yield Stages(
            lambda stage, text, fraction: console.print(stage) if fraction == 0.0 and not text else None, started
        )
    else:
        columns = (SpinnerColumn(), TextColumn("{task.description:<16}"), BarColumn(), TimeElapsedColumn())
        with Progress(*columns, TextColumn("{task.fields[text]}"), console=console) as bars:
            tasks: dict[str, TaskID] = {}

            def show(stage: str, text: str, fraction: float) -> None:
                if stage not in tasks:
                    tasks[stage] = bars.add_task(stage, total=1.0, text=text)
                bars.update(tasks[stage], completed=fraction, text=text)

            yield Stages(show, started)
