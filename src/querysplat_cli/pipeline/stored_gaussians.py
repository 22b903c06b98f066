"""The Gaussians of a stored scene: its own, and the backdrop behind them."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from querysplat_cli.pipeline.full_size import LargePhotos
from querysplat_cli.pipeline.gaussian_files import file_of_scene, folder_of_scene
from querysplat_cli.pipeline.read_scene import read_scene_gaussians
from querysplat_cli.pipeline.scene_folder import StoredScene
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.gaussians import Gaussians, joined


@dataclass(frozen=True)
class StoredGaussians:
    """The Gaussians in a scene's file, in the frame in which the scene was made. `backdrop` has none in many scenes."""

    own: Gaussians
    backdrop: Gaussians

    @property
    def all(self) -> Gaussians:
        """Those of the file, in its order."""
        return joined(self.own, self.backdrop)


def stored_gaussians(path: Path, scene: StoredScene, report: dict[str, Any]) -> StoredGaussians:
    """The Gaussians beside the scene folder. Raises QuerySplatError where they are other ones.

    Without this check, a file that was copied over the scene's own would lose Gaussians as a backdrop, or be replaced.
    """
    whole, reported = read_scene_gaussians(path, scene), report["gaussians"]
    if len(whole) != reported:
        raise QuerySplatError(
            f"{file_of_scene(path)} has {len(whole):,} Gaussians, and {folder_of_scene(path)} is of {reported:,}",
            "Put the scene's own file back, or take a copy that `convert` cut, with the folder beside it.",
        )
    own = len(whole) - scene.backdrop
    return StoredGaussians(whole[:own], whole[own:])


def before_new_backdrop(scene: StoredScene, gaussians: Gaussians) -> tuple[StoredScene, Gaussians]:
    """The scene and its Gaussians, with a new backdrop if it had one."""
    if not scene.backdrop:
        return scene, gaussians
    behind = LargePhotos(scene.views, scene.cameras, exposures=scene.exposures).backdrop(gaussians)
    return replace(scene, backdrop=len(behind)), joined(gaussians, behind)
