"""What the viewer's page shows: Gaussians, and the cameras and photos beside them."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from querysplat_cli.pipeline.gaussian_files import file_of_scene, folder_of_scene, read_gaussians
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.drafts import scratch_folder
from querysplat_cli.scene.files import with_name
from querysplat_cli.scene.formats.ply import write_ply
from querysplat_cli.scene.formats.transforms import NamedCameras, read_working_cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.paths import first_shown, opaque_centres, surround
from querysplat_cli.scene.quantiles import picked
from querysplat_cli.scene.upright import up_direction
from querysplat_cli.splat.conventions import RenderSettings

HEADER_BYTES = 1 << 16
"""No .ply of Gaussians has a longer header."""
GZIP = b"\x1f\x8b"
"""With which an .spz up to version 3 begins."""
OUTSIDE_SIZE = (720, 960)
"""Height and width of the first picture of a scene without cameras."""
DEPTH_SHARES = (0.05, 0.95)
"""Quantiles of the camera z of what the photos show; they become white and black."""
FARTHEST = 1e5
"""The viewer's far plane, in near planes. Every Gaussian of a scene of ours is nearer."""
JPEG_QUALITY = 90


@dataclass(frozen=True)
class ViewedScene:
    """A scene as the page shows it.

    manifest: what `viewer/page.js` reads; a later version of the same scene has another `version`.
    gaussians: their file, under the name that the manifest gives, or what would be in it.
    photos: picture files, by the names that the manifest gives.
    """

    manifest: dict[str, Any]
    gaussians: Path | bytes
    photos: Mapping[str, Path] = field(default_factory=dict)

    def file(self, name: str, largest: int | None = None) -> bytes | None:
        """What the page calls `name`; None where there is nothing. Photos have at most `largest` pixels a side."""
        if name == "scene.json":
            return json.dumps(self.manifest).encode()
        if name == self.manifest["gaussians"]:
            return self.gaussians if isinstance(self.gaussians, bytes) else self.gaussians.read_bytes()
        return _jpeg_file(self.photos[name], largest) if name in self.photos else None


def viewed_scene(path: Path) -> ViewedScene:
    """The scene at `path`: a file of Gaussians, or the folder beside it.

    Raises QuerySplatError when the Gaussians or the cameras beside them cannot be read.
    """
    path = with_name(path)
    file, folder = file_of_scene(path), folder_of_scene(path)
    gaussians, cameras = read_gaussians(file), folder / "cameras.json"
    inputs, heldout, frame = read_working_cameras(cameras) if cameras.is_file() else (None, None, None)
    inputs, heldout = (named and named.transformed(frame) for named in (inputs, heldout))
    pictures = folder / "images"
    views: list[dict[str, Any]] = []
    photos: dict[str, Path] = {}
    files = [file for named in (inputs, heldout) if named for file in named.files]
    entries = (*view_entries(inputs), *view_entries(heldout, held_out=True))
    for entry, file_name in zip(entries, files, strict=True):
        picture = pictures / file_name
        if picture.is_file():
            entry["photo"] = f"photos/{len(views)}.jpg"
            photos[entry["photo"]] = picture
        views.append(entry)
    shown: Path | bytes = file if _page_reads(file) else _as_ply(gaussians)
    kind = "ply" if isinstance(shown, bytes) else file.suffix.lower()[1:]
    manifest = {
        **framing(gaussians, inputs, frame.scale if frame else None),
        "name": file.stem,
        "kind": kind,
        "gaussians": f"scene.{kind}",
        "version": 0,
        "views": views,
        "live": False,
        "state": "",
    }
    return ViewedScene(manifest, shown, photos)


def _page_reads(file: Path) -> bool:
    """Whether the page (`viewer/splats.js`) reads a file as it is: a .ply as we write it, an old .spz or a .sog."""
    kind = file.suffix.lower()
    if kind not in (".ply", ".spz", ".sog"):
        return False
    with file.open("rb") as stream:
        start = stream.read(HEADER_BYTES)
    if kind == ".ply":
        header, end, _ = start.partition(b"\nend_header\n")
        little_endian = header.startswith(b"ply\nformat binary_little_endian 1.0\n")
        return bool(end) and little_endian and header.count(b"\nelement ") == 1
    return kind == ".sog" or start.startswith(GZIP)


def _as_ply(gaussians: Gaussians) -> bytes:
    """For files that the page cannot read."""
    with scratch_folder() as folder:
        write_ply(folder / "scene.ply", gaussians)
        return (folder / "scene.ply").read_bytes()


def framing(gaussians: Gaussians, inputs: NamedCameras | None, unit: float | None = None) -> dict[str, Any]:
    """From where the scene is seen first, and the ranges of what can be set.

    `unit` is one unit of the splatter's limits in those of the scene; None takes 1 where there are input cameras, and
    the distance of the first picture elsewhere.
    """
    points = opaque_centres(gaussians)
    outside = surround(points, 1, *OUTSIDE_SIZE)
    cameras = inputs.cameras if inputs else outside
    middle, sizes = points.median(0).values, gaussians.scales.amax(1)
    if unit is None:
        unit = 1.0 if inputs else float((outside.centres[0] - middle).norm())
    near = RenderSettings().near * unit
    return {
        "up": up_direction(cameras).tolist() if inputs else [0.0, -1.0, 0.0],
        "middle": middle.tolist(),
        "near": near,
        "far": FARTHEST * near,
        "depth": _depth_range(points, cameras, near),
        "sizes": [max(float(picked(sizes, 0.01)), 1e-9), max(float(sizes.max()), 1e-9)],
        "outside": view_entries(NamedCameras(("",), outside, (OUTSIDE_SIZE,)))[0],
        "first": first_shown(cameras),
    }


def _depth_range(points: Float[Tensor, "n 3"], cameras: Cameras, near: float) -> list[float]:
    seen = [cameras.local(points[cameras.sees(points, view)], view)[:, 2] for view in range(len(cameras))]
    depths = torch.cat(seen).clamp_min(near)
    if not len(depths):
        return [near, FARTHEST * near]
    first, last = picked(depths, *DEPTH_SHARES).tolist()
    return [first, max(last, 1.01 * first)]


def view_entries(named: NamedCameras | None, *, held_out: bool = False) -> list[dict[str, Any]]:
    """What the page reads about the cameras of `named`."""
    if named is None:
        return []
    c2w, (fx, fy, cx, cy) = named.cameras.c2w.tolist(), (part.tolist() for part in named.cameras.intrinsics)
    rows = zip(named.names, named.sizes, c2w, fx, fy, cx, cy, strict=True)
    keys = "c2w", "fx", "fy", "cx", "cy"
    return [
        {
            "name": name,
            "held_out": held_out,
            "width": width,
            "height": height,
            **dict(zip(keys, rest, strict=True)),
            "photo": None,
        }
        for name, (height, width), *rest in rows
    ]


def jpeg(picture: np.ndarray, largest: int | None = None) -> bytes:
    """A picture as OpenCV holds it (BGR), as a JPEG file of at most `largest` pixels a side."""
    share = min(1.0, largest / max(picture.shape[:2])) if largest else 1.0
    if share < 1:
        picture = cv2.resize(picture, None, fx=share, fy=share, interpolation=cv2.INTER_AREA)
    return cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()


def _jpeg_file(path: Path, largest: int | None) -> bytes | None:
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
    return None if picture is None else jpeg(picture, largest)
