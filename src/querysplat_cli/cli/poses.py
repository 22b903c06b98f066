"""`querysplat poses`: two sets of cameras of the same photos."""

from pathlib import Path
from typing import Annotated

import typer

from querysplat_cli.cli.options import Force, Json, Quiet, Seed
from querysplat_cli.runtime.errors import QuerySplatError


def poses(
    first: Annotated[
        Path,
        typer.Argument(metavar="A", help="Scene folder, transforms.json or COLMAP model, by its photos for --colmap."),
    ],
    second: Annotated[Path | None, typer.Argument(metavar="[B]", help="What A is measured against.")] = None,
    colmap: Annotated[bool, typer.Option(help="Measure A's cameras against COLMAP's own, run on A's photos.")] = False,
    plot: Annotated[Path | None, typer.Option(help="Draw both trajectories to a .png, .svg or .pdf.")] = None,
    seed: Seed = 42,
    force: Force = False,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Compare cameras after the similarity that joins them: rotation, centre, RRA, RTA, AUC, ATE, focal length."""
    if (second is None) != colmap:
        raise QuerySplatError("give two sets of cameras, or one and --colmap", "See `querysplat poses --help`.")
    from querysplat_cli.cli.console import print_poses
    from querysplat_cli.evaluation.colmap_reference import estimate_with_colmap
    from querysplat_cli.evaluation.poses import compare_cameras, draw_trajectories
    from querysplat_cli.scene.files import refuse_existing
    from querysplat_cli.scene.formats.known import read_known_cameras
    from querysplat_cli.scene.photos import find_photos, load_photos

    if plot:
        refuse_existing([plot], force=force)
    mine = read_known_cameras(first)
    if second:
        theirs, title = read_known_cameras(second), str(second)
    else:
        theirs, title = estimate_with_colmap(load_photos(find_photos([first]))[0], seed=seed), "COLMAP"
    errors = compare_cameras(mine, theirs)
    if plot:
        draw_trajectories(errors, plot, (str(first), title))
    print_poses(errors.summary(), str(first), title, quiet=quiet, as_json=json)
