"""`querysplat weights`: which files the official presets need, and whether they are here."""

from pathlib import Path
from typing import Annotated

import typer

from querysplat_cli.cli.options import Json, Quiet
from querysplat_cli.runtime.errors import QuerySplatError


def weights(
    folder: Annotated[
        Path | None, typer.Option("--weights", help="Their folder; the Hugging Face cache by default.")
    ] = None,
    verify: Annotated[
        bool, typer.Option("--verify", help="Read the files that are here: sha256, tensor names and shapes.")
    ] = False,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """List the weights that are not part of this package: origin, licence, size, and what is here."""
    from querysplat_cli.cli.console import print_weights, showing_stages
    from querysplat_cli.commands.weights import survey

    with showing_stages(quiet=quiet) as stages:
        found = survey(folder, verify=verify, stages=stages)
    print_weights(found, quiet=quiet, as_json=json)
    wrong = [each.wanted.file for each in found if each.fault]
    if wrong:
        raise QuerySplatError(f"{', '.join(wrong)} cannot be used", "Fetch it again from where the list says.")
