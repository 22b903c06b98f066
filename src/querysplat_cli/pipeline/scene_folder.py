"""The scene folder: what `querysplat tto` needs later, and what a user may want to look at.

scene.ply
scene/
  cameras.json             nerfstudio form; held-out views under "heldout_frames"
  images/                  the undistorted photos that the cameras belong to
  photos.json              where the photos themselves lie, and their lenses, if the encoder knows these
  exposures.json           the colour transforms of the input photos, if these differ in exposure
  memories.safetensors     memories, anchors, masks and depth, and the model that they belong to
  report.json
  preview.png
  curve.png                error against time, if it was optimised
"""

import dataclasses
import json
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from querysplat_cli.model.anchors import Anchors
from querysplat_cli.model.memories import Memories
from querysplat_cli.queries.prepare import MemoryMap
from querysplat_cli.reporting.convergence_plot import write_curve
from querysplat_cli.reporting.preview import write_preview
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.exposures import Exposures, read_exposures, write_exposures
from querysplat_cli.scene.files import atomic_folder, atomic_path
from querysplat_cli.scene.formats.ply import write_ply
from querysplat_cli.scene.formats.transforms import read_cameras, write_cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.photo_files import PhotoFile, read_photo_files, write_photo_files
from querysplat_cli.scene.pictures import LOSSLESS_SUFFIXES, eight_bit, stored_name, write_picture
from querysplat_cli.scene.views import Views

JPEG_SETTINGS = (cv2.IMWRITE_JPEG_QUALITY, 100, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444)


@dataclass(frozen=True)
class StoredScene:
    """A scene that can be optimised further.

    `model` is the preset or checkpoint that decodes the memories. `kept` marks the decoded Gaussians that belong to
    the scene (None: all). `photos` are the files of input and held-out photos by name; it may lack some. The last
    Gaussians of the .ply, as many as `backdrop` says, are the backdrop. `exposures` are the colour transforms of the
    input views (None: they show the scene's own colours).
    """

    views: Views
    cameras: Cameras
    heldout: tuple[Views, Cameras] | None
    memories: Memories
    anchors: Anchors | None
    model: str
    map: MemoryMap | None = None
    kept: Bool[Tensor, "n"] | None = None
    photos: dict[str, PhotoFile] = dataclasses.field(default_factory=dict)
    backdrop: int = 0
    exposures: Exposures | None = None

    @property
    def groups(self) -> dict[str, tuple[Views, Cameras]]:
        """The input views, and the held-out views if there are any."""
        inputs = {"input": (self.views, self.cameras)}
        return {**inputs, "held out": self.heldout} if self.heldout else inputs


def scene_folder(ply: Path) -> Path:
    """The folder beside a scene's .ply."""
    return ply.with_suffix("")


def ply_path(path: Path) -> Path:
    """The .ply of a scene; `path` is its folder or the .ply itself."""
    return path if path.suffix.lower() == ".ply" else path.with_name(f"{path.name}.ply")


def write_scene(ply: Path, scene: StoredScene, gaussians: Gaussians, report: dict[str, Any]) -> int:
    """Write, or replace, `ply` and the folder beside it; returns the number of Gaussians in the file.

    Everything is written to temporary names first, so an interruption leaves what was there before.
    """
    folder = scene_folder(ply)
    with atomic_path(ply) as ply_draft, atomic_folder(folder) as draft:
        written = write_ply(ply_draft, gaussians)
        for views, _ in scene.groups.values():
            write_images(draft / "images", views)
        write_cameras(draft / "cameras.json", scene.cameras, scene.views, heldout=scene.heldout)
        if scene.photos:
            write_photo_files(draft / "photos.json", list(scene.photos.values()))
        if scene.exposures:
            write_exposures(draft / "exposures.json", scene.views.names, scene.exposures)
        masks = torch.cat([views.masks for views, _ in scene.groups.values()])
        tensors = {"masks": masks, **_flatten("memories", scene.memories)}
        if scene.anchors is not None:
            tensors |= _flatten("anchors", scene.anchors)
        if scene.kept is not None:
            tensors["kept"] = scene.kept
        if scene.map is not None:
            tensors |= _flatten("map", scene.map)
        # Not by `save_file`, which makes files that only their owner may read.
        (draft / "memories.safetensors").write_bytes(save(tensors, metadata={"model": scene.model}))
        (draft / "report.json").write_text(json.dumps(report, indent=2) + "\n")
        write_preview(draft / "preview.png", gaussians, scene.groups)
        if any(run["curve"] for run in report["tto"]):
            write_curve(draft / "curve.png", report["tto"])
    return written


def write_images(folder: Path, views: Views) -> None:
    """Write the pictures, without their padding, under the names of `views`; lossless, or JPEG at its best quality."""
    for image, name, (height, width) in zip(views.images, views.names, views.sizes, strict=True):
        path = folder / stored_name(name)
        settings = () if path.suffix.lower() in LOSSLESS_SUFFIXES else JPEG_SETTINGS
        write_picture(path, eight_bit(image[:, :height, :width]), settings)


def read_scene(path: Path) -> tuple[StoredScene, dict[str, Any]]:
    """The scene and the report in a folder that `write_scene` made; `path` is the folder or its .ply.

    Raises QuerySplatError when a part is missing or damaged.
    """
    folder = scene_folder(path) if path.suffix.lower() == ".ply" else path
    memories = folder / "memories.safetensors"
    if not memories.is_file():
        raise QuerySplatError(
            f"{folder} has no memories.safetensors: nothing was reconstructed there",
            "Give the folder (or the .ply beside it) that `querysplat reconstruct` wrote.",
        )
    try:
        with safe_open(memories, framework="pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
            model = file.metadata()["model"]
        report = json.loads((folder / "report.json").read_text())
        inputs, heldout = read_cameras(folder / "cameras.json")
        photos = read_photo_files(folder / "photos.json")
        count = len(inputs.names)
        views = _read_images(folder / "images", inputs.names, inputs.sizes, tensors["masks"][:count])
        held = None
        if heldout:
            masks = tensors["masks"][count:]
            held = _read_images(folder / "images", heldout.names, heldout.sizes, masks), heldout.cameras
        anchors = _unflatten(Anchors, "anchors", tensors) if "anchors.means" in tensors else None
        where = _unflatten(MemoryMap, "map", tensors) if "map.grid" in tensors else None
        memory = _unflatten(Memories, "memories", tensors)
        exposures = read_exposures(folder / "exposures.json", inputs.names)
        kept, behind = tensors.get("kept"), int(report.get("backdrop", 0))
        scene = StoredScene(views, inputs.cameras, held, memory, anchors, model, where, kept, photos, behind, exposures)
    except (OSError, SafetensorError, KeyError, ValueError) as error:
        raise QuerySplatError(f"{folder} is damaged: {error}", "Run `querysplat reconstruct` again.") from error
    return scene, report


def _flatten(name: str, part: Any) -> dict[str, Tensor]:
    """A dataclass of tensors and of such dataclasses, as named tensors."""
    if not is_dataclass(part):
        return {name: part.detach().contiguous().clone()}
    flat: dict[str, Tensor] = {}
    for field in fields(part):
        flat |= _flatten(f"{name}.{field.name}", getattr(part, field.name))
    return flat


def _unflatten(kind: Any, name: str, tensors: dict[str, Tensor]) -> Any:
    if not is_dataclass(kind):
        return tensors[name].float() if tensors[name].is_floating_point() else tensors[name]
    parts = {field.name: _unflatten(field.type, f"{name}.{field.name}", tensors) for field in fields(kind)}
    return kind(**parts)  # type: ignore[operator]


def _read_images(folder: Path, names: tuple[str, ...], sizes: tuple[tuple[int, int], ...], masks: Tensor) -> Views:
    images = torch.zeros(len(names), 3, *masks.shape[1:])
    for row, (name, (height, width)) in enumerate(zip(names, sizes, strict=True)):
        pixels = cv2.imread(str(folder / stored_name(name)), cv2.IMREAD_COLOR)
        if pixels is None or pixels.shape[:2] != (height, width):
            raise OSError(f"images/{stored_name(name)} is missing or has another size")
        images[row, :, :height, :width] = (
            torch.from_numpy(np.ascontiguousarray(pixels[..., ::-1])).permute(2, 0, 1) / 255
        )
    return Views(images, masks, names, sizes)
