"""Views of a scene on which a conversion is compared with its source."""

from dataclasses import dataclass, replace
from pathlib import Path

import torch

from querysplat_cli.pipeline.gaussian_files import folder_of_scene
from querysplat_cli.pipeline.read_scene import read_scene
from querysplat_cli.prune.policy import PRUNE_POLICY
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.sequences import evenly_spaced
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.formats.transforms import NamedCameras, read_working_cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.paths import opaque_centres, surround
from querysplat_cli.scene.sim3 import Sim3
from querysplat_cli.scene.views import Views
from querysplat_cli.splat.render import render
from querysplat_cli.splat.transform import transform_gaussians

ORBIT_SIZE = 240, 320
"""Height and width of the views of a scene without cameras."""
ORBIT_UNITS = 3.0
"""Their distance from the scene. The splatter's limits suit scenes of about this size."""
EQUAL = 1e-10
"""Mean squared error that pictures are at least taken to have: equal ones have 100 dB."""


@dataclass(frozen=True)
class ComparedViews:
    """Cameras, in a frame that `frame` maps to that of the file, and the pictures that they are to show.

    kind: "photos", or "inputs" or "orbit" where the pictures are renders of the source from there.
    judges: all cameras of that kind, by which importance is judged; `cameras` are a few of them.
    """

    kind: str
    cameras: Cameras
    pictures: Views
    frame: Sim3
    judges: Cameras

    def __len__(self) -> int:
        return len(self.cameras)

    def here(self, gaussians: Gaussians) -> Gaussians:
        """Gaussians of the file, in the frame of the cameras."""
        return transform_gaussians(gaussians, self.frame.inverse())

    @torch.no_grad()
    def psnr(self, here: Gaussians) -> float:
        """Mean over the views, in dB, of Gaussians in the frame of the cameras."""
        found = []
        for view in range(len(self)):
            difference = _drawn(here, self.cameras, view) - self.pictures.picture(view)
            found.append(-10 * difference.square()[:, self.pictures.masks[view]].mean().clamp_min(EQUAL).log10())
        return float(torch.stack(found).mean())


def cameras_beside(source: Path) -> tuple[NamedCameras, Sim3] | None:
    """The input cameras in the folder of a scene, in the frame in which it was made, and the way to that of its files.

    None where there are none.
    """
    file = folder_of_scene(source) / "cameras.json"
    if not file.is_file():
        return None
    inputs, _, frame = read_working_cameras(file)
    return inputs, frame or Sim3.identity()


def compared_views(source: Path, gaussians: Gaussians) -> ComparedViews:
    """A few input photos; without photos the input cameras; without these, views from all around."""
    beside = cameras_beside(source)
    if beside is None:
        middle = opaque_centres(gaussians)
        cameras = surround(middle, PRUNE_POLICY.tested_views, *ORBIT_SIZE)
        distance = float((cameras.centres - middle.median(0).values).norm(dim=1).max())
        frame = Sim3(distance / ORBIT_UNITS, torch.eye(3).double(), torch.zeros(3).double())
        cameras = cameras.transformed(frame.inverse())
        return _of_renders(ComparedViews("orbit", cameras, _blank(cameras), frame, cameras), gaussians)
    inputs, frame = beside
    some = evenly_spaced(range(len(inputs.names)), PRUNE_POLICY.tested_views)
    if (folder_of_scene(source) / "memories.safetensors").is_file():
        try:
            scene, _ = read_scene(source)
            return ComparedViews("photos", scene.cameras[some], scene.views[some], frame, scene.cameras)
        except QuerySplatError:
            pass  # a folder that is damaged, or another scene's, is no reason not to convert
    height, width = (max(side) for side in zip(*inputs.sizes, strict=True))
    cameras = replace(inputs.cameras, height=height, width=width)
    return _of_renders(ComparedViews("inputs", cameras[some], _blank(cameras[some]), frame, cameras), gaussians)


def _blank(cameras: Cameras) -> Views:
    count, height, width = len(cameras), cameras.height, cameras.width
    masks = torch.ones(count, height, width, dtype=torch.bool)
    names = tuple(map(str, range(count)))
    return Views(torch.zeros(count, 3, height, width), masks, names, ((height, width),) * count)


def _of_renders(views: ComparedViews, gaussians: Gaussians) -> ComparedViews:
    here = views.here(gaussians)
    with torch.no_grad():
        pictures = torch.stack([_drawn(here, views.cameras, view) for view in range(len(views))])
    return replace(views, pictures=replace(views.pictures, images=pictures))


def _drawn(gaussians: Gaussians, cameras: Cameras, view: int) -> torch.Tensor:
    return render(gaussians, cameras[[view]]).colour[0].clamp(0, 1)
