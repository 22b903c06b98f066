"""What `render` does: a .ply and cameras become pictures or a film."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import torch

from querysplat_cli.commands.requests import RenderRequest
from querysplat_cli.pipeline.gaussian_files import (
    file_of_scene,
    folder_of_scene,
    read_gaussians,
    refuse_replacing_scene,
)
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.limits import require_memory
from querysplat_cli.runtime.progress import Stages
from querysplat_cli.scene.cameras import Cameras, PhotoCamera, rescaled, same_shape
from querysplat_cli.scene.files import FolderKind, atomic_folder, atomic_path, refuse_existing, with_name
from querysplat_cli.scene.film_colours import bt709_frame, state_bt709
from querysplat_cli.scene.formats.known import GAUSSIAN_KINDS, MODEL_KINDS, find_known_cameras, read_pinholes
from querysplat_cli.scene.formats.llff import POSES_BOUNDS
from querysplat_cli.scene.formats.transforms import (
    NamedCameras,
    listed_files,
    working_frame,
    write_transforms,
)
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.paths import centred, interpolate, opaque_centres, orbit, scene_middle, surround, usual_depth
from querysplat_cli.scene.photos import FILM_SUFFIXES, SUFFIXES
from querysplat_cli.scene.pictures import distinct_stems, eight_bit, write_picture
from querysplat_cli.scene.sim3 import Sim3
from querysplat_cli.splat.render import Rendering, render
from querysplat_cli.splat.surface_depth import SurfaceDepth, surface_depth
from querysplat_cli.splat.transform import transform_gaussians

FOREIGN_SIZE = (720, 960)
"""Height and width of the frames of a scene without cameras, unless the user gives a size."""
DEPTH_UNITS = 1000
"""Steps of a 16-bit depth PNG in one scene unit. 0 is a pixel without Gaussians, 65,535 the greatest depth."""

ORBIT_FRAMES = 90
"""Pictures of an orbit, unless the user asks for another number."""
STEP_SECONDS, FILM_SECONDS = 1.5, (3.0, 12.0)
"""How long a film takes from one input camera to the next, and altogether at least and at most."""
OTHER_KINDS = {*SUFFIXES, ".gif", *FILM_SUFFIXES - {".mp4"}, *GAUSSIAN_KINDS, ".json"}
"""Endings of files, in a target, that are no films and no names of folders."""
BESIDE = ("_depth.png", "_alpha.png", "_depth.npy", "_confidence.npy")
"""Endings of the files beside a picture, in place of its .png."""
FILM_SIDES = 2, 16_384
"""The fewest and the most pixels of a film's side: H.264 needs even ones, and libx264 takes no more."""
PIXEL_BYTES = 100
"""About the memory of one pixel while a picture is rendered and written."""


def frame_files(folder: Path) -> set[str]:
    """What `render` wrote to `folder`: its cameras.json, the pictures that it lists, and the files beside these."""
    listed = {name.removeprefix("images/") for name in listed_files(folder)}
    return listed | {name.removesuffix(".png") + ending for name in listed for ending in BESIDE}


FRAMES = FolderKind(("cameras.json",), listed=("*",), listing=frame_files)


@dataclass(frozen=True)
class Rendered:
    """What was written, and the seconds of each stage."""

    output: str
    frames: int
    gaussians: int
    seconds: dict[str, float]


def render_file(request: RenderRequest, stages: Stages) -> Rendered:
    """Render `request.scene` to a folder of PNG frames, or to a film if the target ends in .mp4."""
    scene = file_of_scene(with_name(request.scene))
    refuse_replacing_scene(scene, request.target, instead="-pictures")
    refuse_existing([request.target], force=request.force, kind=None if request.is_film else FRAMES)
    _check_target(request)
    with stages("read"):
        gaussians = read_gaussians(scene)
        beside = folder_of_scene(scene) / "cameras.json"
        names, cameras, sizes = _cameras(request, beside, gaussians)
        _check_names(names, request)
        listed = _listed(names, cameras, sizes, request.size)
        frame = _frame(beside, gaussians, cameras)
        gaussians = transform_gaussians(gaussians, frame.inverse())
        cameras = cameras.transformed(frame.inverse()).to(torch.float32)
    height, width = request.size or (max(side) for side in zip(*sizes, strict=True))
    if request.is_film:
        _check_film(height, width)
    require_memory(PIXEL_BYTES * height * width, f"pictures of {width:,} × {height:,} pixels")
    with stages("render") as progress:
        pictures = _render_each(gaussians, cameras, sizes, request, progress)
        if request.is_film:
            with atomic_path(request.target) as draft:
                _write_film(draft, pictures, request.fps)
        else:
            with atomic_folder(request.target) as draft:
                for name, (picture, surface) in zip(names, pictures, strict=True):
                    _write_frame(draft / name, picture, request, frame.scale)
                    if surface is not None:
                        _write_floats(draft / name, surface, frame.scale)
                write_transforms(draft / "cameras.json", listed)
    return Rendered(str(request.target), len(cameras), len(gaussians), stages.seconds)


def _check_target(request: RenderRequest) -> None:
    if request.is_film and (request.depth or request.alpha or request.float_depth):
        raise QuerySplatError("depth and --alpha are pictures, not films", "Write to a folder instead of an .mp4.")
    if request.seconds and not request.is_film:
        raise QuerySplatError("--seconds is for films", "Write to an .mp4, or leave it out.")
    if request.seconds and request.frames:
        raise QuerySplatError("--frames and --seconds both set the length of an orbit", "Leave one of them out.")
    if request.target.suffix.lower() in OTHER_KINDS:
        raise QuerySplatError(
            f"{request.target}: frames go into a folder, and films into an .mp4", "Choose another output."
        )


def _check_film(height: int, width: int) -> None:
    fewest, most = FILM_SIDES
    if not fewest <= min(height, width) <= max(height, width) <= most:
        why = f"a film of {width:,} × {height:,} pixels: its sides have at least {fewest} pixels and at most {most:,}"
        raise QuerySplatError(why, "Ask for another --size, or write to a folder.")


def _check_names(names: list[str], request: RenderRequest) -> None:
    """Raise QuerySplatError where two pictures would have one name: that of two cameras, or a depth's and a camera's.

    The frames of a film have no names.
    """
    given = Counter(names)
    twice = next((name for name, count in given.items() if count > 1), None)
    if twice and not request.is_film:
        why = f"--cameras: several cameras are called {twice}, and each picture has the name of its camera"
        raise QuerySplatError(why, "Give each frame a file_path of its own, or write a film.")
    for part, wanted in (("depth", request.depth), ("alpha", request.alpha)):
        both = [name for name in names if wanted and f"{name}_{part}" in given]
        if both:
            why = f"--{part}: that of the camera {both[0]} would have the name of the picture {both[0]}_{part}.png"
            raise QuerySplatError(why, f"Leave --{part} out, or rename a camera.")


Path3D = tuple[list[str], Cameras, list[tuple[int, int]]]
"""Names, cameras and picture sizes (height, width) of the pictures."""


def _cameras(request: RenderRequest, beside: Path, gaussians: Gaussians) -> Path3D:
    """What is rendered, in the frame of the files. `beside` is the scene's cameras.json, which may be missing."""
    known = read_pinholes(beside) if beside.is_file() and request.cameras in ("auto", "orbit") else None
    still = request.is_film and known is not None and len(known.names) == 1
    if request.cameras == "orbit" or (request.cameras == "auto" and (known is None or still)):
        return _orbit(request, known, gaussians)
    if request.frames is not None:
        raise QuerySplatError("--frames is for orbits", "Add --cameras orbit, or leave it out; films have --seconds.")
    file = beside if request.cameras in ("auto", "inputs") else Path(request.cameras)
    if not (request.cameras and file.exists()):
        hint = f"Use --cameras orbit, or --cameras FILE with a transforms.json, a COLMAP model or a {POSES_BOUNDS}."
        raise QuerySplatError(f"{file}: no cameras there", hint)
    if file.is_dir() or file.suffix.lower() in (*MODEL_KINDS, *GAUSSIAN_KINDS):
        file = find_known_cameras(file)
    inputs = read_pinholes(file)
    if request.is_film and (file == beside or request.seconds):
        return _through(inputs, request)
    if request.is_film and not request.size and not all(same_shape(size, inputs.sizes[0]) for size in inputs.sizes):
        raise QuerySplatError(
            f"{file}: its cameras have pictures of several shapes, and a film has one",
            "Write to a folder, or add --seconds for a smooth path through the cameras.",
        )
    return distinct_stems(inputs.names), inputs.cameras, list(inputs.sizes)


def _frame(beside: Path, gaussians: Gaussians, cameras: Cameras) -> Sim3:
    """The way from the frame in which pictures are rendered to that of the files.

    The first is that in which the scene was made, where the file `beside` states it, since the splatter's limits are in
    its units. Of a file of another program, surfaces get the depth that they have there. Cameras stand at the origin:
    float32 tells places best there.
    """
    known = beside.is_file()
    if known and (stated := working_frame(beside)):
        return stated
    unit = 1.0 if known else usual_depth(gaussians, cameras)
    return Sim3(unit, torch.eye(3).double(), cameras.centres.mean(0))


def _orbit(request: RenderRequest, known: NamedCameras | None, gaussians: Gaussians) -> Path3D:
    """A path around the scene, at the height and distance of the `known` cameras if there are any."""
    asked = request.frames or ORBIT_FRAMES
    frames = asked if request.seconds is None else max(1, round(request.seconds * request.fps))
    if known:
        size = known.sizes[0]
        path = orbit(replace(known.cameras, height=size[0], width=size[1]), scene_middle(gaussians), frames)
    else:
        size = request.size or FOREIGN_SIZE
        path = surround(opaque_centres(gaussians).double(), frames, *size)
    return _numbered(path, size)


def _through(inputs: NamedCameras, request: RenderRequest) -> Path3D:
    """A smooth path through the cameras, in their order."""
    usual = min(max(STEP_SECONDS * (len(inputs.names) - 1), FILM_SECONDS[0]), FILM_SECONDS[1])
    size = inputs.sizes[0]
    frames = max(2, round((request.seconds or usual) * request.fps))
    path = interpolate(replace(inputs.cameras, height=size[0], width=size[1]), frames)
    return _numbered(centred(path), size)


def _numbered(path: Cameras, size: tuple[int, int]) -> Path3D:
    return [f"frame_{i:04d}" for i in range(len(path))], path, [size] * len(path)


def _listed(
    names: list[str], cameras: Cameras, sizes: list[tuple[int, int]], asked: tuple[int, int] | None
) -> dict[str, PhotoCamera]:
    """The cameras of the pictures by their file names, in the frame of the scene's files."""
    found = {}
    for i, (name, (height, width)) in enumerate(zip(names, sizes, strict=True)):
        camera = PhotoCamera.pinhole(cameras.w2c[i].double().numpy(), cameras.K[i].double().numpy(), height, width)
        found[f"{name}.png"] = rescaled(camera, *asked) if asked else camera
    return found


def _render_each(
    gaussians: Gaussians, cameras: Cameras, sizes: list[tuple[int, int]], request: RenderRequest, progress: Any
) -> Iterator[tuple[Rendering, SurfaceDepth | None]]:
    """Each picture, and the depth of its surface where that is asked for."""
    background = torch.tensor(request.background)
    for i, (height, width) in enumerate(sizes):
        view = Cameras(cameras.w2c[[i]], cameras.K[[i]], height, width)
        if request.size:
            view = view.resized(*request.size)
        with torch.no_grad():
            picture = render(gaussians, view, background=background)
            yield picture, surface_depth(gaussians, view, picture) if request.float_depth else None
        progress("", (i + 1) / len(sizes))


def _write_frame(path: Path, picture: Rendering, request: RenderRequest, unit: float) -> None:
    """Write one frame's pictures. `unit` is one unit of the rendering in those of the scene's files."""
    write_picture(path.with_name(f"{path.name}.png"), eight_bit(picture.colour[0].clamp(0, 1)))
    if request.depth:
        steps = (picture.depth[0] * unit * DEPTH_UNITS).round().clamp(0, 65535)
        write_picture(path.with_name(f"{path.name}_depth.png"), steps.numpy().astype(np.uint16))
    if request.alpha:
        write_picture(
            path.with_name(f"{path.name}_alpha.png"), (picture.alpha[0] * 255).round().to(torch.uint8).numpy()
        )


def _write_floats(path: Path, surface: SurfaceDepth, unit: float) -> None:
    """Depth in units of the scene's files, and its confidence, as arrays [height, width] of float32."""
    np.save(path.with_name(f"{path.name}_depth.npy"), (surface.depth * unit).numpy())
    np.save(path.with_name(f"{path.name}_confidence.npy"), surface.confidence.numpy())


def _write_film(path: Path, pictures: Iterator[tuple[Rendering, SurfaceDepth | None]], fps: int) -> None:
    """Write an H.264 film, which every browser and player shows."""
    with av.open(str(path), "w") as film:
        stream = None
        for picture, _ in pictures:
            frame = eight_bit(picture.colour[0].clamp(0, 1))
            frame = frame[: frame.shape[0] // 2 * 2, : frame.shape[1] // 2 * 2]  # H.264 needs even sizes
            if stream is None:
                stream = film.add_stream("libx264", rate=fps, options={"crf": "18"})
                stream.height, stream.width, stream.pix_fmt = frame.shape[0], frame.shape[1], "yuv420p"
                state_bt709(stream)
            film.mux(stream.encode(bt709_frame(frame)))
        if stream is not None:
            film.mux(stream.encode())
