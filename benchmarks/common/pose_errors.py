"""Found cameras against true ones, where a similarity aligns the two."""

from collections.abc import Mapping

from querysplat_cli.evaluation.poses import PoseErrors, compare_cameras
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.sim3 import DegenerateAlignment


def pose_errors(found: Mapping[str, PhotoCamera], true: Mapping[str, PhotoCamera]) -> PoseErrors | None:
    """None where fewer than two photos are in both, or no similarity aligns them."""
    try:
        return compare_cameras(found, true)
    except (QuerySplatError, DegenerateAlignment):
        return None
