"""Options that several verbs share."""

from collections.abc import Callable
from enum import StrEnum
from typing import Annotated

import typer

Force = Annotated[bool, typer.Option("--force", help="Replace what is there already.")]
Json = Annotated[bool, typer.Option("--json", help="Print the result as one JSON object on standard output.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Say nothing but errors.")]
Seed = Annotated[int, typer.Option(help="The same seed on the same machine gives the same file.")]
Device = Annotated[str, typer.Option(help="auto, cpu, or cuda.")]


class TtoSpace(StrEnum):
    features = "features"
    gaussians = "gaussians"
    both = "both"


def number_or_auto(smallest: int) -> Callable[[str], int | None]:
    """A parser for `auto` (None) or a whole number of at least `smallest`."""

    def parse(text: str) -> int | None:
        if text == "auto":
            return None
        if not text.isdecimal() or int(text) < smallest:
            raise typer.BadParameter(f"{text!r} is neither `auto` nor a whole number of at least {smallest}")
        return int(text)

    return parse
