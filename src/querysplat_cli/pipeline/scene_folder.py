"""The scene folder: what `querysplat tto` needs later, and what a user may want to look at.

scene.ply
scene/
  cameras.json             nerfstudio form; held-out views under "heldout_frames"; in the frame of given cameras
  images/                  the undistorted photos that the cameras belong to
  photos.json              where the photos themselves lie, and their lenses, if the encoder knows these
  points.safetensors       points of structure from motion, and which photos observe them, if the encoder has any
  exposures.json           the colour transforms of the input photos, if these differ in exposure
  memories.safetensors     memories, anchors, masks and depth, and the model that they belong to
  report.json
  preview.png
  curve.png                error against time, if it was optimised
  supersplat.json          settings for SuperSplat's viewer: it opens the scene at a photo
"""

import dataclasses
import json
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path, PurePath
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool
from safetensors.torch import save
from torch import Tensor

from querysplat_cli.model.anchors import Anchors
from querysplat_cli.model.memories import Memories
from querysplat_cli.pipeline.gaussian_files import folder_of_scene, read_gaussians, write_gaussians
from querysplat_cli.pipeline.stored_tensors import StoredTensors, flattened
from querysplat_cli.queries.prepare import MemoryMap
from querysplat_cli.reporting.convergence_plot import write_curve
from querysplat_cli.reporting.omissions import PRECISION, Omission, of_kind
from querysplat_cli.reporting.preview import write_preview
from querysplat_cli.reporting.report import quality_entry
from querysplat_cli.reporting.view_scores import score
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.exposures import Exposures, write_exposures
from querysplat_cli.scene.files import FolderKind, atomic_together, can_be_named
from querysplat_cli.scene.formats.supersplat import write_supersplat
from querysplat_cli.scene.formats.transforms import listed_files, write_cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.photo_files import PhotoFile, write_photo_files
from querysplat_cli.scene.pictures import LOSSLESS_SUFFIXES, eight_bit, stored_names, write_picture
from querysplat_cli.scene.sim3 import Sim3
from querysplat_cli.scene.sparse_points import SparsePoints, write_sparse_points
from querysplat_cli.scene.views import Photo, Views
from querysplat_cli.splat.transform import transform_gaussians

JPEG_SETTINGS = (cv2.IMWRITE_JPEG_QUALITY, 100, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444)

SCENE_FOLDER = FolderKind(("cameras.json",), ("*",), ("cameras.json", "images/*"), listed_files)
"""A scene's folder may hold other files, which stay in it (`keep_others`). Those in `images/` have to be listed, as
pictures of a new scene could have their names."""
PARTS = {
    *("cameras.json", "images", "photos.json", "points.safetensors", "exposures.json", "memories.safetensors"),
    *("report.json", "preview.png", "curve.png", "supersplat.json"),
}


@dataclass(frozen=True)
class StoredScene:
    """A scene that can be optimised further.

    `model` is the preset or checkpoint that decodes the memories. `kept` marks the decoded Gaussians that belong to
    the scene (None: all). `photos` are the files of input and held-out photos by name; it may lack some. The last
    Gaussians, as many as `backdrop` says, are the backdrop. `exposures` are the colour transforms of the input views
    (None: they show the scene's own colours). `points` are those of structure from motion (None: there are none).

    Everything here is in the frame in which the scene was made. `frame` maps it to that of the files. It is None where
    the two are one: with `--frame vgm`, unless cameras are given or the scene is in metres.
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
    frame: Sim3 | None = None
    backdrop: int = 0
    exposures: Exposures | None = None
    points: SparsePoints | None = None

    @property
    def joined(self) -> bool:
        """Whether regions became this scene: there is nothing left that decodes to it."""
        return not len(self.memories.geometry_keys)

    @property
    def groups(self) -> dict[str, tuple[Views, Cameras]]:
        """The input views, and the held-out views if there are any."""
        inputs = {"input": (self.views, self.cameras)}
        return {**inputs, "held out": self.heldout} if self.heldout else inputs


def scores_of(scene: StoredScene, gaussians: Gaussians) -> dict[str, Any]:
    """The scores on input and held-out photos, as a report has them; `gaussians` are in the frame of the scene."""
    groups = {"input": (scene.views, scene.cameras), "heldout": scene.heldout}
    return {name: quality_entry(score(gaussians, *group)) if group else None for name, group in groups.items()}


def keep_others(folder: Path, draft: Path) -> None:
    """Copy to `draft` what the scene folder `folder`, which it is to replace, holds beside the parts of a scene.

    What is in `images/`, and is no picture of the scene, is copied, too.
    """
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        if path.name in PARTS:
            continue
        if path.is_dir() and not path.is_symlink():
            shutil.copytree(path, draft / path.name, symlinks=True)
        else:
            shutil.copy2(path, draft / path.name, follow_symlinks=False)
    pictures = listed_files(folder)
    for path in sorted((folder / "images").rglob("*")):
        name = path.relative_to(folder)
        if not path.is_dir() and name.as_posix() not in pictures:
            (draft / name.parent).mkdir(parents=True, exist_ok=True)
            shutil.copy2(path, draft / name, follow_symlinks=False)


def write_scene(target: Path, scene: StoredScene, gaussians: Gaussians, report: dict[str, Any]) -> int:
    """Write, or replace, `target` (a kind of `WRITERS`) and the folder beside it; returns how many Gaussians it has.

    `report` gets the size of the file, under `bytes`, the number of `gaussians` in it, and under `left_out` what its
    kind loses, where that is not .ply. Everything is written to temporary names first, so an interruption leaves what
    was there before.
    """
    with atomic_together(target, folder_of_scene(target)) as (target_draft, draft):
        draft.mkdir()
        placed = transform_gaussians(gaussians, scene.frame) if scene.frame else gaussians
        written = write_gaussians(target_draft, placed)
        report["bytes"], report["gaussians"] = target_draft.stat().st_size, written
        report["left_out"] = [
            *(entry for entry in report["left_out"] if entry["what"] != PRECISION),
            *(asdict(each) for each in _lost_by_kind(target_draft, scene, placed, report)),
        ]
        listing = draft / "cameras.json"
        files = write_cameras(listing, scene.cameras, scene.views, heldout=scene.heldout, frame=scene.frame)
        for views, _ in scene.groups.values():
            write_images(draft / "images", views, files, folder_of_scene(target) / "images")
        write_supersplat(draft / "supersplat.json", gaussians, scene.cameras, scene.views.sizes, scene.frame)
        if scene.photos:
            write_photo_files(draft / "photos.json", list(scene.photos.values()))
        if scene.exposures:
            write_exposures(draft / "exposures.json", scene.views.names, scene.exposures)
        if scene.points:
            write_sparse_points(draft, scene.points)
        masks = torch.cat([views.masks for views, _ in scene.groups.values()])
        tensors = flattened(StoredTensors(masks, scene.memories, scene.anchors, scene.kept, scene.map))
        # Not by `save_file`, which makes files that only their owner may read.
        (draft / "memories.safetensors").write_bytes(save(tensors, metadata={"model": scene.model}))
        (draft / "report.json").write_text(json.dumps(report, indent=2) + "\n")
        write_preview(draft / "preview.png", gaussians, scene.groups)
        if any(run["curve"] for run in report["tto"]):
            write_curve(draft / "curve.png", report["tto"])
        keep_others(folder_of_scene(target), draft)
    return written


def _lost_by_kind(file: Path, scene: StoredScene, placed: Gaussians, report: dict[str, Any]) -> list[Omission]:
    """What a written file of another kind than .ply loses of the `placed` Gaussians on the input views."""
    if file.suffix.lower() == ".ply":
        return []
    found = read_gaussians(file)
    here = transform_gaussians(found, scene.frame.inverse()) if scene.frame else found
    after = score(here, scene.views, scene.cameras).summary()["psnr"]
    return of_kind(file, placed, round(report["quality"]["input"]["psnr"] - after, 3))


def check_picture_names(folder: Path, photos: Sequence[Photo]) -> None:
    """Raise QuerySplatError where a photo's picture would have too long a name for the file system of `folder`.

    Pictures of photos in formats that are not written have longer names than these.
    """
    for name, file in stored_names([photo.name for photo in photos]).items():
        if not can_be_named(folder / PurePath(file).name):
            why = f"{name}: its name is too long for its picture in the scene's folder"
            raise QuerySplatError(why, "Rename the photo.")


def write_images(folder: Path, views: Views, files: Mapping[str, str], stored: Path) -> None:
    """Write the pictures, without their padding; lossless, or JPEG at its best quality.

    `files` has the names of the pictures (`stored_names`) by those of `views`. A picture whose file is in the folder
    `stored` is copied: as JPEG, it would lose something each time. Raises QuerySplatError when a name leads out of the
    folder.
    """
    for row, (name, (height, width)) in enumerate(zip(views.names, views.sizes, strict=True)):
        path = folder / files[name]
        if os.path.isabs(name) or ".." in path.parts:
            raise QuerySplatError(f"the picture of {name} would lie outside the scene's folder", "Rename the photo.")
        pixels, before = eight_bit(views.images[row, :, :height, :width]), stored / files[name]
        if path.suffix.lower() in LOSSLESS_SUFFIXES:
            write_picture(path, pixels)
        elif before.is_file() and np.array_equal(np.asarray(cv2.imread(str(before))), pixels[..., ::-1]):
            path.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(before, path)
        else:
            write_picture(path, pixels, JPEG_SETTINGS)
