"""A scene folder is read: every part is checked, and then the parts against each other."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from PIL import Image, UnidentifiedImageError
from torch import Tensor

from querysplat_cli.model.config import ModelConfig
from querysplat_cli.pipeline.gaussian_files import file_of_scene, folder_of_scene, read_gaussians
from querysplat_cli.pipeline.scene_folder import StoredScene
from querysplat_cli.pipeline.stored_tensors import DamagedTensors, checked
from querysplat_cli.reporting.stored_report import read_report
from querysplat_cli.runtime.checkpoint_files import read_tensors
from querysplat_cli.runtime.errors import MAKE_AGAIN, QuerySplatError
from querysplat_cli.scene.exposures import read_exposures
from querysplat_cli.scene.formats.transforms import NamedCameras, read_working_cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.photo_files import read_photo_files
from querysplat_cli.scene.sparse_points import read_sparse_points
from querysplat_cli.scene.views import Views
from querysplat_cli.splat.transform import transform_gaussians


def require_scene(path: Path) -> Path:
    """The memories' file of the scene that has this folder, or these Gaussians. Raises QuerySplatError without any."""
    memories = folder_of_scene(path) / "memories.safetensors"
    if not memories.is_file():
        raise QuerySplatError(
            f"{memories.parent} has no memories.safetensors: nothing was reconstructed there",
            "Give the folder (or the .ply beside it) that `querysplat reconstruct` wrote.",
        )
    return memories


def read_scene(path: Path) -> tuple[StoredScene, dict[str, Any]]:
    """The scene and the report in a folder that `write_scene` made; `path` is the folder, or the Gaussians beside it.

    Raises QuerySplatError when a part is missing, damaged, or does not fit the others.
    """
    memories = require_scene(path)
    folder = memories.parent
    report = read_report(folder / "report.json")
    inputs, heldout, frame = read_working_cameras(folder / "cameras.json")
    names = [*inputs.names, *(heldout.names if heldout else ())]
    photos = read_photo_files(folder / "photos.json")
    tensors, metadata = read_tensors(memories)
    canvas = inputs.cameras.height, inputs.cameras.width
    try:
        if len(set(names)) < len(names):
            raise DamagedTensors("two pictures in cameras.json have one name")
        if "model" not in metadata:
            raise DamagedTensors("memories.safetensors does not name its model")
        stored = checked(tensors, len(inputs.names), len(names), canvas)
        views = _read_images(folder / "images", inputs, stored.masks[: len(inputs.names)])
        held = None
        if heldout:
            held = _read_images(folder / "images", heldout, stored.masks[len(inputs.names) :]), heldout.cameras
    except (OSError, DamagedTensors, cv2.error, Image.DecompressionBombError) as error:
        raise QuerySplatError(f"{folder} is damaged: {error}", MAKE_AGAIN) from error
    parts = stored.memories, stored.anchors, metadata["model"], stored.map, stored.kept
    points = read_sparse_points(folder, inputs.names, photos)
    exposures = read_exposures(folder / "exposures.json", inputs.names)
    rest = photos, frame, report.get("backdrop", 0), exposures, points
    return StoredScene(views, inputs.cameras, held, *parts, *rest), report


def read_scene_gaussians(path: Path, scene: StoredScene) -> Gaussians:
    """The Gaussians beside a scene folder, in the frame in which the scene was made."""
    gaussians = read_gaussians(file_of_scene(path))
    return transform_gaussians(gaussians, scene.frame.inverse()) if scene.frame else gaussians


def check_model(scene: StoredScene, config: ModelConfig) -> None:
    """Raise QuerySplatError unless the memories and anchors of `scene` are those of a model with this `config`."""
    memories, anchors, each = scene.memories, scene.anchors, config.gaussians_per_query
    size = (config.heads, config.width // config.heads)
    patches = (scene.cameras.height // config.patch) * (scene.cameras.width // config.patch)
    rows = None if scene.map is None or not len(scene.map.appearance_rows) else int(scene.map.appearance_rows.max())
    count = config.query_count if anchors is None else len(anchors)
    fits = {
        "memories": all(tuple(part.shape[1:]) == size for part in vars(memories).values()),
        "anchors": (anchors is None) == (config.queries == "learned"),
        "anchors.features": anchors is None or anchors.features.shape[1] == config.anchor_features,
        "anchors.means": anchors is None or anchors.means.shape[1] == each,
        "anchors.refinement": anchors is None or anchors.refinement.shape[2] in (0, config.raw_channels),
        "kept": scene.kept is None or len(scene.kept) == count * each,
        "map.appearance_rows": rows is None or rows < len(scene.views) * patches,
    }
    wrong = [name for name, fit in fits.items() if not fit]
    if wrong:
        raise QuerySplatError(
            f"the scene does not fit its model {scene.model}: {', '.join(wrong)}",
            "Give the model's own files, or run `querysplat reconstruct` again.",
        )


def _read_images(folder: Path, named: NamedCameras, masks: Tensor) -> Views:
    images = torch.zeros(len(named.names), 3, *masks.shape[1:])
    for row, (name, (height, width)) in enumerate(zip(named.names, named.sizes, strict=True)):
        file = folder / named.files[row]
        if _size(file) != (height, width):
            raise OSError(f"images/{named.files[row]} is missing or has another size")
        pixels = cv2.imread(str(file), cv2.IMREAD_COLOR)
        if pixels is None or pixels.shape[:2] != (height, width):
            raise OSError(f"images/{named.files[row]} cannot be decoded")
        images[row, :, :height, :width] = (
            torch.from_numpy(np.ascontiguousarray(pixels[..., ::-1])).permute(2, 0, 1) / 255
        )
        if masks[row, height:].any() or masks[row, :, width:].any():
            raise DamagedTensors(f"the mask of {name} reaches beyond its picture")
    return Views(images, masks, named.names, named.sizes)


def _size(file: Path) -> tuple[int, int] | None:
    """(height, width) that a picture's file states; None where there is no such picture."""
    try:
        with Image.open(file) as image:
            return image.height, image.width
    except (UnidentifiedImageError, OSError, ValueError, SyntaxError):
        return None
