"""The application: every verb, in the order in which a newcomer meets them."""

import typer

from querysplat_cli.cli import convert, demo, evaluate, inspect, poses, reconstruct, render, train, tto, weights

app = typer.Typer(
    name="querysplat",
    help="Turn a handful of photos into a 3D Gaussian splatting scene, on a bare CPU.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
app.command("reconstruct")(reconstruct.reconstruct)
app.command("tto")(tto.tto)
app.command("render")(render.render)
app.command("eval")(evaluate.evaluate)
app.command("poses")(poses.poses)
app.command("convert")(convert.convert)
app.command("inspect")(inspect.inspect)
app.command("demo")(demo.demo)
app.command("train")(train.train)
app.command("weights")(weights.weights)
