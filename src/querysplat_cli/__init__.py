"""QuerySplat as a library: photos without camera poses become a 3D Gaussian splatting scene.

The names below are imported when they are first used, so that `import querysplat_cli` loads neither torch nor pycolmap.
"""

from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

from querysplat_cli.runtime.caches import find_caches
from querysplat_cli.runtime.threads import limit_threads, wait_shortly

if TYPE_CHECKING:
    from querysplat_cli.commands.library import Scene, open_scene, optimise, reconstruct, render
    from querysplat_cli.encoders.registry import register_encoder
    from querysplat_cli.pipeline.resume_settings import ResumeSettings
    from querysplat_cli.pipeline.settings import ReconstructSettings
    from querysplat_cli.runtime.errors import QuerySplatError
    from querysplat_cli.scene.cameras import Cameras
    from querysplat_cli.scene.formats.ply import read_ply, write_ply
    from querysplat_cli.scene.gaussians import Gaussians
    from querysplat_cli.splat.render import register_splatter

__all__ = [
    "Cameras",
    "Gaussians",
    "QuerySplatError",
    "ReconstructSettings",
    "ResumeSettings",
    "Scene",
    "__version__",
    "open_scene",
    "optimise",
    "read_ply",
    "reconstruct",
    "register_encoder",
    "register_splatter",
    "render",
    "write_ply",
]

_PLACES = {
    "Cameras": "scene.cameras",
    "Gaussians": "scene.gaussians",
    "QuerySplatError": "runtime.errors",
    "ReconstructSettings": "pipeline.settings",
    "ResumeSettings": "pipeline.resume_settings",
    "Scene": "commands.library",
    "open_scene": "commands.library",
    "optimise": "commands.library",
    "read_ply": "scene.formats.ply",
    "reconstruct": "commands.library",
    "register_encoder": "encoders.registry",
    "register_splatter": "splat.render",
    "render": "commands.library",
    "write_ply": "scene.formats.ply",
}
"""The module of each name."""

try:
    __version__ = version("querysplat")
except PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0+unknown"

# The command line and the library both come through here, and neither has imported torch or numba yet.
wait_shortly()
limit_threads()
find_caches()


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_PLACES[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
