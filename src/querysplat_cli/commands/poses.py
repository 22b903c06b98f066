"""What `poses` does: the errors of one set of cameras against another."""

from typing import Any

from querysplat_cli.commands.requests import PosesRequest
from querysplat_cli.evaluation.colmap_reference import estimate_with_colmap
from querysplat_cli.evaluation.poses import compare_cameras, draw_trajectories
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.files import refuse_existing
from querysplat_cli.scene.formats.known import read_known_cameras
from querysplat_cli.scene.photos import find_photos, load_photos


def compare(request: PosesRequest) -> tuple[dict[str, Any], str]:
    """The errors of the first set of cameras, in degrees and in units of the second set, and the second set's name.

    Raises QuerySplatError unless the request has either a second set or `colmap`.
    """
    if (request.second is None) != request.colmap:
        raise QuerySplatError("give two sets of cameras, or one and --colmap", "See `querysplat poses --help`.")
    if request.plot:
        refuse_existing([request.plot], force=request.force)
    first = read_known_cameras(request.first)
    if request.second:
        second, name = read_known_cameras(request.second), str(request.second)
    else:
        second, name = estimate_with_colmap(load_photos(find_photos([request.first]))[0], seed=request.seed), "COLMAP"
    errors = compare_cameras(first, second)
    if request.plot:
        draw_trajectories(errors, request.plot, (str(request.first), name))
    return errors.summary(), name
