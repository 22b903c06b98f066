"""One training sample and its file: the frozen VGM's output for the inputs alone, and targets in the same frame."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from querysplat_cli.encoders.base import CameraRequest, Encoder, Geometry
from querysplat_cli.encoders.holdout import isolated_split
from querysplat_cli.runtime.choices import Frame
from querysplat_cli.runtime.errors import ImpossibleScene, QuerySplatError
from querysplat_cli.runtime.progress import silent
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.files import atomic_path
from querysplat_cli.scene.sim3 import rigid
from querysplat_cli.scene.views import Views
from querysplat_cli.training.captures import Capture

LARGE_FEATURES = 64
"""Channels above which a sample's file has features in 16 bits."""


@dataclass(frozen=True)
class Sample:
    """The VGM's pass over the inputs, and the targets with cameras in its frame. Targets enter the losses only."""

    views: Views
    cameras: Cameras
    geometry: Geometry
    targets: Views
    target_cameras: Cameras

    def in_frame(self, frame: Frame) -> "Sample":
        """The same sample; with the frame "first_view", the first input's camera is the origin exactly."""
        if frame == "predicted":
            return self
        move = rigid(self.cameras.w2c[0])
        cameras, targets = self.cameras.transformed(move), self.target_cameras.transformed(move)
        return replace(self, cameras=cameras, target_cameras=targets)


def make_sample(shot: Capture, encoder: Encoder, *, max_size: int, seed: int) -> Sample:
    """A sample from two separate passes, over all photos of a capture and over its inputs.

    The similarity between the inputs' cameras of both passes brings the targets' cameras to the inputs' frame.

    Raises ImpossibleScene when an input or every target is left without a camera.
    """
    # The inputs come last: some encoders keep the pass that they made last for their depth and features.
    request = CameraRequest(max_size, seed, shot.known)
    everything = encoder.estimate_cameras(shot.photos, request, silent)
    chosen = [photo for photo in shot.photos if photo.name in shot.inputs]
    own = encoder.estimate_cameras(chosen, request, silent)
    if len(own.views) < len(chosen):
        raise ImpossibleScene(f"{len(chosen) - len(own.views)} of {len(chosen)} inputs have no camera")
    heldout = isolated_split(own, everything, shot.inputs)[0].heldout
    if heldout is None:
        raise ImpossibleScene("no target can be brought to the inputs' frame")
    return Sample(own.views, own.cameras, encoder.estimate_geometry(own, seed=seed, progress=silent), *heldout)


def write_sample(path: Path, sample: Sample) -> None:
    """Pictures in 8 bits and depth in 16; features in 16 where they come from a network (more channels than 64)."""
    geometry = sample.geometry
    tensors = {
        "views.images": _bytes(sample.views.images),
        "views.masks": sample.views.masks,
        "views.w2c": sample.cameras.w2c,
        "views.K": sample.cameras.K,
        "targets.images": _bytes(sample.targets.images),
        "targets.masks": sample.targets.masks,
        "targets.w2c": sample.target_cameras.w2c,
        "targets.K": sample.target_cameras.K,
    }
    if geometry.depth is not None and geometry.confidence is not None:
        # float16 ends at 65,504. Its relative error of 0.05 % is far below that of any estimated depth.
        tensors |= {"depth": geometry.depth.clamp(1e-4, 6e4).half(), "confidence": geometry.confidence.half()}
    for i, layer in enumerate(geometry.features):
        tensors[f"features.{i}"] = layer.bfloat16() if layer.shape[-1] > LARGE_FEATURES else layer
    metadata = {
        "patch": geometry.patch,
        "names": [sample.views.names, sample.targets.names],
        "sizes": [sample.views.sizes, sample.targets.sizes],
    }
    with atomic_path(path) as draft:
        kept = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
        draft.write_bytes(save(kept, metadata={"sample": json.dumps(metadata)}))


def read_sample(path: Path) -> Sample:
    """The sample that `write_sample` wrote; raises QuerySplatError when the file is damaged."""
    try:
        with safe_open(path, framework="pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
            metadata = json.loads(file.metadata()["sample"])
        count = sum(name.startswith("features.") for name in tensors)
        geometry = Geometry(
            tensors["depth"].float() if "depth" in tensors else None,
            tensors["confidence"].float() if "confidence" in tensors else None,
            tuple(tensors[f"features.{i}"].float() for i in range(count)),
            metadata["patch"],
        )
        views, cameras = _read_views("views", 0, tensors, metadata)
        return Sample(views, cameras, geometry, *_read_views("targets", 1, tensors, metadata))
    except (OSError, SafetensorError, LookupError, TypeError, ValueError, AttributeError, RecursionError) as error:
        raise QuerySplatError(f"{path} is damaged: {error}", "Delete it, and it is made again.") from error


def _read_views(part: str, row: int, tensors: Mapping[str, Tensor], metadata: dict[str, Any]) -> tuple[Views, Cameras]:
    images = tensors[f"{part}.images"].float() / 255
    sizes = tuple((height, width) for height, width in metadata["sizes"][row])
    views = Views(images, tensors[f"{part}.masks"], tuple(metadata["names"][row]), sizes)
    return views, Cameras(tensors[f"{part}.w2c"], tensors[f"{part}.K"], images.shape[2], images.shape[3])


def _bytes(images: Tensor) -> Tensor:
    return torch.from_numpy(np.rint(images.clamp(0, 1).cpu().numpy() * 255).astype(np.uint8))
