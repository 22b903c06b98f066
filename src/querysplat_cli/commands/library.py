"""The library: photos to a scene and a scene to pictures, from Python. Nothing is printed."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import torch

from querysplat_cli.pipeline.gaussian_files import file_of_scene, folder_of_scene, is_streamed, read_gaussians
from querysplat_cli.pipeline.reconstruct import reconstruct as make_scene
from querysplat_cli.pipeline.resume import optimise_scene
from querysplat_cli.pipeline.resume_settings import ResumeSettings
from querysplat_cli.pipeline.settings import ReconstructSettings
from querysplat_cli.reporting.report import Report
from querysplat_cli.reporting.stored_report import read_report
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.progress import Stages
from querysplat_cli.runtime.tables import from_values
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.formats.transforms import NamedCameras, read_cameras, working_frame
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.paths import usual_depth
from querysplat_cli.splat.conventions import RenderSettings
from querysplat_cli.splat.render import Rendering
from querysplat_cli.splat.render import render as draw

Place = str | Path
Listener = Callable[[str, str, float], None]
"""Called with the stage, a text about the current work, and the finished fraction of the stage. What it raises ends
the work, and nothing is written then."""


@dataclass(frozen=True)
class Scene:
    """A scene on disk: `ply` are its Gaussians, and `report` is that of its last run (None where it has none).

    Everything else is read when it is first used, in the frame of the file. Reading raises QuerySplatError where a
    part is missing or damaged.
    """

    ply: Path
    report: Report | None = None

    @property
    def folder(self) -> Path:
        """The folder beside the file, which has cameras, photos, preview and report."""
        return folder_of_scene(self.ply)

    @cached_property
    def gaussians(self) -> Gaussians:
        """The Gaussians of the file, in float32, with their backdrop where they have one."""
        return read_gaussians(self.ply)

    @property
    def cameras(self) -> Cameras:
        """The cameras of the input photos, at the working size, with one canvas that has room for all of `sizes`."""
        return self._cameras[0].cameras

    @property
    def sizes(self) -> tuple[tuple[int, int], ...]:
        """Height and width of each input photo, in the order of `cameras`; its pixels begin at the top left."""
        return self._cameras[0].sizes

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the input photos, in the order of `cameras`."""
        return tuple(self._cameras[0].names)

    @property
    def heldout_cameras(self) -> Cameras | None:
        """The cameras of the held-out photos; None where there are none."""
        heldout = self._cameras[1]
        return heldout.cameras if heldout else None

    @cached_property
    def _cameras(self) -> tuple[NamedCameras, NamedCameras | None]:
        file = self.folder / "cameras.json"
        if not file.is_file():
            raise QuerySplatError(f"{self.ply} has no cameras of its own: there is no {file}", "Give some.")
        return read_cameras(file)


def reconstruct(
    photos: Place | Iterable[Place], output: Place = "scene.ply", *, progress: Listener | None = None, **settings: Any
) -> Scene:
    """Make a scene of photos: the file `output` and the folder beside it.

    `photos` is a folder, or picture files. `settings` are the fields of `ReconstructSettings`, such as
    `holdout_every=4`. Raises QuerySplatError for bad input, and ImpossibleScene where no scene can be made of the
    photos; nothing is written then.
    """
    inputs = (photos,) if isinstance(photos, str | Path) else tuple(photos)
    values = {"inputs": inputs, "ply": output, **settings}
    report = make_scene(from_values(ReconstructSettings, values, what="reconstruct"), _stages(progress))
    return Scene(Path(report.ply), report)


def optimise(scene: Scene | Place, *, progress: Listener | None = None, **settings: Any) -> Scene:
    """Optimise a scene further, as `querysplat tto` does, and return it as it is then.

    `settings` are the fields of `ResumeSettings`, such as `steps=50` or `quality="high"`. Raises QuerySplatError where
    the scene is damaged, or the settings contradict each other; the scene stays as it was then.
    """
    values = {"scene": scene.ply if isinstance(scene, Scene) else scene, **settings}
    report = optimise_scene(from_values(ResumeSettings, values, what="optimise"), _stages(progress))
    return Scene(Path(report.ply), report)


def open_scene(path: Place) -> Scene:
    """The scene in a folder that `reconstruct` wrote, or in a .ply, .spz, .sog, .glb or .lod of any program.

    Raises QuerySplatError where there is no such file, or where its report is damaged.
    """
    ply = file_of_scene(Path(path))
    if not ply.is_file() and not (is_streamed(ply) and ply.is_dir()):
        raise QuerySplatError(f"{path}: no such scene", "Give the folder or the .ply of a scene.")
    report = folder_of_scene(ply) / "report.json"
    return Scene(ply, Report.from_dict(read_report(report)) if report.is_file() else None)


def render(scene: Scene | Gaussians | Place, cameras: Cameras | None = None, **how: Any) -> Rendering:
    """Pictures of a scene or of Gaussians, differentiably: `colour`, `alpha` and `depth` of every view.

    A `Scene`, or that at a place, is shown from its own cameras by default; Gaussians need some. `how` are the other
    arguments of `querysplat_cli.splat.render.render`: `background` (three numbers), `settings`, `backend`.
    """
    if how.get("background") is not None:
        how["background"] = torch.as_tensor(how["background"], dtype=torch.float32)
    if isinstance(scene, str | Path):
        scene = open_scene(scene)
    if isinstance(scene, Scene):
        cameras = cameras if cameras is not None else scene.cameras
        if "settings" not in how:
            how["settings"] = _limits(scene, cameras)
        return draw(scene.gaussians, cameras, **how)
    if cameras is None:
        raise QuerySplatError("Gaussians have no cameras of their own", "Give render(gaussians, cameras).")
    return draw(scene, cameras, **how)


def _limits(scene: Scene, cameras: Cameras) -> RenderSettings:
    """The splatter's limits in the units of the file: they are made for those in which a scene is made."""
    beside, usual = folder_of_scene(scene.ply) / "cameras.json", RenderSettings()
    if beside.is_file():
        frame = working_frame(beside)
        unit = frame.scale if frame else 1.0
    else:
        unit = usual_depth(scene.gaussians, cameras)
    return replace(usual, near=usual.near * unit, far=usual.far * unit)


def _stages(progress: Listener | None) -> Stages:
    return Stages(progress) if progress else Stages()
