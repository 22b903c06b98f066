"""The application: every verb, in the order in which a newcomer meets them."""

import typer

from querysplat_cli.cli.convert import convert
from querysplat_cli.cli.demo import demo
from querysplat_cli.cli.evaluate import evaluate
from querysplat_cli.cli.export import export
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

app = typer.Typer(
    name="querysplat",
    help="Turn a handful of photos into a 3D Gaussian splatting scene, on a bare CPU.",
    add_completion=False,
    pretty_exceptions_enable=False,
)
for function in (reconstruct, tto, view, render, export, evaluate, poses, convert, info, inspect, demo, train, weights):
    app.command("eval" if function is evaluate else function.__name__)(verb(function))
