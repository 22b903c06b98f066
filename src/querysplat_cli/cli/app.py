"""The application: every verb, in the order in which a newcomer meets them."""

import click

from querysplat_cli.cli.convert import convert
from querysplat_cli.cli.demo import demo
from querysplat_cli.cli.evaluate import evaluate
from querysplat_cli.cli.inspect import inspect
from querysplat_cli.cli.poses import poses
from querysplat_cli.cli.reconstruct import reconstruct
from querysplat_cli.cli.render import render
from querysplat_cli.cli.train import train
from querysplat_cli.cli.tto import tto
from querysplat_cli.cli.verb import verb
from querysplat_cli.cli.weights import weights


class InOrder(click.Group):
    """A group whose help lists the verbs in the order in which they were added."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self.commands)


app = InOrder(
    "querysplat",
    help="Turn a handful of photos into a 3D Gaussian splatting scene, on a bare CPU.",
    context_settings={"max_content_width": 100},
    no_args_is_help=True,
)
for function in (reconstruct, tto, render, evaluate, poses, convert, inspect, demo, train, weights):
    app.add_command(verb(function, "eval" if function is evaluate else function.__name__))
