"""Cameras of whole photos by name, and in the frame of other cameras."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch

from querysplat_cli.encoders.base import PosedViews
from querysplat_cli.scene.cameras import Cameras, PhotoCamera
from querysplat_cli.scene.sim3 import DegenerateAlignment, Sim3, align_cameras


def cameras_by_name(posed: PosedViews) -> dict[str, PhotoCamera]:
    """Each photo's camera with its lens, before the photo was cropped or padded where the encoder gives that."""
    views, cameras = posed.views, posed.cameras
    found = posed.photo_cameras or map(_pinhole, cameras.w2c.double(), cameras.K.double(), views.masks)
    return dict(zip(views.names, found, strict=True))


def to_frame_of(reference: Mapping[str, PhotoCamera], cameras: Mapping[str, PhotoCamera]) -> dict[str, PhotoCamera]:
    """`cameras` in the frame of `reference`, by the similarity of the photos that are in both.

    Raises DegenerateAlignment when fewer than two photos are, or their cameras do not fix a similarity.
    """
    shared = [name for name in reference if name in cameras]
    if len(shared) < 2:
        raise DegenerateAlignment("fewer than two inputs have cameras together with the targets")
    similarity = align_cameras(_poses(cameras, shared), _poses(reference, shared))
    return {name: _transformed(camera, similarity) for name, camera in cameras.items()}


def _poses(cameras: Mapping[str, PhotoCamera], names: list[str]) -> torch.Tensor:
    return torch.stack([torch.from_numpy(cameras[name].w2c) for name in names])


def _pinhole(w2c: torch.Tensor, K: torch.Tensor, mask: torch.Tensor) -> PhotoCamera:
    """The camera of the photo that fills the rectangle where `mask` is True."""
    rows, columns = (mask.any(axis).nonzero()[:, 0].tolist() for axis in (1, 0))
    cut = K.numpy() - np.array([[0, 0, columns[0]], [0, 0, rows[0]], [0, 0, 0]])
    return PhotoCamera.pinhole(w2c.numpy(), cut, rows[-1] + 1 - rows[0], columns[-1] + 1 - columns[0])


def _transformed(camera: PhotoCamera, similarity: Sim3) -> PhotoCamera:
    alone = Cameras(torch.from_numpy(camera.w2c)[None], torch.eye(3)[None], 1, 1)
    return replace(camera, w2c=alone.transformed(similarity).w2c[0].numpy())
