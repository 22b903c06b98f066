"""Depth maps that come with the photos, on their way to the encoder."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from querysplat_cli.encoders.base import PosedViews
from querysplat_cli.pipeline.settings import ReconstructSettings
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.depth_maps import depth_of_photo, depth_of_view, with_depth_maps
from querysplat_cli.scene.views import Photo, PhotoSource


def photos_with_depth(
    photos: Sequence[Photo], settings: ReconstructSettings, known: Mapping[str, PhotoCamera] | None, encoder: str
) -> list[Photo]:
    """The photos with the depth maps of `--depth-maps`, or else with those that are listed with their `known` cameras.

    Raises QuerySplatError where `--depth-maps` has none of them, or where `encoder` uses none.
    """
    if settings.depth_maps and encoder != "classical":
        raise QuerySplatError(
            f"--depth-maps: the encoder {encoder} estimates depth itself", "Leave it out, or use --encoder classical."
        )
    cameras = known if known and encoder == "classical" else {}
    listed = {name: camera.depth_map for name, camera in cameras.items() if camera.depth_map}
    return with_depth_maps(photos, settings.depth_maps, listed)


def depth_of_views(posed: PosedViews, sources: Mapping[str, PhotoSource]) -> Float[Tensor, "views height width"] | None:
    """The depth maps of the photos as the views see them (`PosedViews.depth_maps`); None where there is none."""
    maps = {name: sources[name].depth_map for name in posed.views.names if name in sources}
    if posed.photo_cameras is None or not any(maps.values()):
        return None
    seen = torch.zeros(posed.views.masks.shape)
    for view, (name, photo, size) in enumerate(
        zip(posed.views.names, posed.photo_cameras, posed.views.sizes, strict=True)
    ):
        file = maps.get(name)
        if file:
            depth = depth_of_photo(file, sources[name], (photo.height, photo.width))
            K = np.asarray(posed.cameras.K[view], np.float64)
            seen[view, : size[0], : size[1]] = torch.from_numpy(depth_of_view(depth, photo, K, size))
    return seen
