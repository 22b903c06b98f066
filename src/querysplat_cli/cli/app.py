"""The application: every verb, in the order in which a newcomer meets them."""

from collections.abc import Callable
from typing import Annotated

import typer

import querysplat_cli
from querysplat_cli.cli.convert import convert
from querysplat_cli.cli.demo import demo
from querysplat_cli.cli.doctor import doctor
from querysplat_cli.cli.evaluate import evaluate
from querysplat_cli.cli.export import export
from querysplat_cli.cli.help_pages import ApplicationHelp, VerbHelp
from querysplat_cli.cli.info import info
from querysplat_cli.cli.inspect import inspect
from querysplat_cli.cli.poses import poses
from querysplat_cli.cli.reconstruct import reconstruct
from querysplat_cli.cli.render import render
from querysplat_cli.cli.train import train
from querysplat_cli.cli.tto import tto
from querysplat_cli.cli.verb import verb
from querysplat_cli.cli.view import view
from querysplat_cli.cli.weights import weights

VERBS: dict[str, tuple[Callable[..., None], ...]] = {
    "Make a scene": (reconstruct, tto, demo),
    "See, share and change it": (view, export, render, convert, info, inspect),
    "Measure": (evaluate, poses),
    "Models": (train, weights),
    "This machine": (doctor,),
}
"""The verbs in the panels of `querysplat --help`."""

app = typer.Typer(
    name="querysplat",
    cls=ApplicationHelp,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["--help", "-h"]},
)


def _print_version(asked: bool) -> bool:
    if asked:
        typer.echo(f"querysplat {querysplat_cli.__version__}")
        raise typer.Exit
    return asked


@app.callback()
def application(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version.", callback=_print_version, is_eager=True)
    ] = False,
) -> None:
    """Turn a handful of photos into a 3D Gaussian splatting scene, on a bare CPU."""


for panel, functions in VERBS.items():
    for function in functions:
        name = "eval" if function is evaluate else function.__name__
        app.command(name, cls=VerbHelp, rich_help_panel=panel)(verb(function))
