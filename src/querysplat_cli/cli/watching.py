"""Stages of a run that can be watched in the browser."""

from collections.abc import Iterator
from contextlib import contextmanager

from querysplat_cli.cli.terminal import say, showing_stages
from querysplat_cli.cli.verb import Printing
from querysplat_cli.commands.requests import Watching
from querysplat_cli.runtime.progress import Stages


@contextmanager
def watching_stages(
    watching: Watching, printing: Printing, name: str, *, started: float | None = None
) -> Iterator[Stages]:
    """`showing_stages`, and with --view the browser shows the scene as well, under `name`."""
    with showing_stages(printing, started=started) as stages:
        if not watching.view:
            yield stages
            return
        from querysplat_cli.commands.live_view import watched

        with watched(stages, name, lambda address: say(f"{address} shows the scene while it is made", printing)):
            yield stages
