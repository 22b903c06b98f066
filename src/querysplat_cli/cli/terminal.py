"""Where output goes: progress and tables to standard error, results for programs to standard output."""

import json
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from time import perf_counter
from typing import Any

from rich.console import Console, RenderableType
from rich.progress import BarColumn, Progress, SpinnerColumn, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

from querysplat_cli.cli.progress_lines import ProgressLines, time_left
from querysplat_cli.cli.verb import Printing
from querysplat_cli.runtime.progress import Stages

console = Console(stderr=True, highlight=False)


def say(text: RenderableType, printing: Printing) -> None:
    """Print for people, unless --quiet."""
    if not printing.quiet:
        # Names of files may hold what rich takes for markup, and a path must not be broken into two.
        console.print(text, markup=False, soft_wrap=isinstance(text, str))


def print_json(result: Any, printing: Printing) -> None:
    """Print for programs, if --json."""
    if printing.json:
        print(json.dumps(result, indent=2), flush=True)  # `view` runs on, and its address is awaited


def rows_table(title: str, rows: Iterable[tuple[str, str]], *, indent: int = 0) -> Table:
    """Two columns without borders: names and what they are."""
    table = Table(title=title, title_justify="left", show_header=False, box=None, padding=(0, 2, 0, 0), pad_edge=False)
    table.add_column()
    table.add_column(overflow="fold")
    for name, text in rows:
        table.add_row(f"{'':{indent}}{name}", Text(text))
    return table


@contextmanager
def showing_stages(printing: Printing, *, started: float | None = None) -> Iterator[Stages]:
    """Stages whose progress is drawn on a terminal, and printed line by line elsewhere; nothing with --quiet.

    `started` is when the command began, by `time.perf_counter`; now by default.
    """
    if printing.quiet:
        yield Stages(started=started)
    elif not console.is_terminal:
        with ProgressLines(lambda text: console.print(text, markup=False, soft_wrap=True)) as lines:
            yield Stages(lines.show, started)
    else:
        columns = (SpinnerColumn(), TextColumn("{task.description:<16}"), BarColumn(), TimeElapsedColumn())
        last = (TextColumn("{task.fields[text]}", markup=False), TextColumn("{task.fields[left]}"))
        with Progress(*columns, *last, console=console) as bars:
            tasks: dict[str, TaskID] = {}
            began: dict[str, float] = {}

            def show(stage: str, text: str, fraction: float) -> None:
                if stage not in tasks:
                    tasks[stage] = bars.add_task(stage, total=1.0, text=text, left="")
                    began[stage] = perf_counter()
                left = time_left(perf_counter() - began[stage], fraction)
                bars.update(tasks[stage], completed=fraction, text=text, left=left)

            yield Stages(show, started)
