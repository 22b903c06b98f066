"""QuerySplat as a library: photos without camera poses become a 3D Gaussian splatting scene.

The names below are imported when they are first used, so that `import querysplat_cli` loads neither torch nor pycolmap.
"""

from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

from querysplat_cli.runtime.caches import find_caches
from querysplat_cli.runtime.threads import wait_passively

if TYPE_CHECKING:
    from querysplat_cli.pipeline.reconstruct import reconstruct
    from querysplat_cli.pipeline.resume import optimise_scene as optimise
    from querysplat_cli.pipeline.settings import ReconstructSettings, ResumeSettings
    from querysplat_cli.scene.cameras import Cameras
    from querysplat_cli.scene.formats.ply import read_ply, write_ply
    from querysplat_cli.scene.gaussians import Gaussians
    from querysplat_cli.splat.render import render

__all__ = [
    "Cameras",
    "Gaussians",
    "ReconstructSettings",
    "ResumeSettings",
    "__version__",
    "optimise",
    "read_ply",
    "reconstruct",
    "render",
    "write_ply",
]

_PLACES = {
    "Cameras": "scene.cameras:Cameras",
    "Gaussians": "scene.gaussians:Gaussians",
    "ReconstructSettings": "pipeline.settings:ReconstructSettings",
    "ResumeSettings": "pipeline.settings:ResumeSettings",
    "optimise": "pipeline.resume:optimise_scene",
    "read_ply": "scene.formats.ply:read_ply",
    "reconstruct": "pipeline.reconstruct:reconstruct",
    "render": "splat.render:render",
    "write_ply": "scene.formats.ply:write_ply",
}

try:
    __version__ = version("querysplat")
except PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0+unknown"

# The command line and the library both come through here, and neither has imported torch or numba yet.
wait_passively()
find_caches()


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, _, attribute = _PLACES[name].partition(":")
    return getattr(import_module(f"{__name__}.{module}"), attribute)


def __dir__() -> list[str]:
    return sorted(__all__)
