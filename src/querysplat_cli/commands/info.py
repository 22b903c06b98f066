"""What `info` does: a scene in numbers, and what is odd about it."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from querysplat_cli.commands.info_plot import draw_info
from querysplat_cli.commands.requests import InfoRequest
from querysplat_cli.commands.samples import quantiles
from querysplat_cli.pipeline.gaussian_files import bytes_of, file_of_scene, folder_of_scene, read_gaussians
from querysplat_cli.reporting.stored_report import backdrop_of
from querysplat_cli.runtime.figures import check_drawing
from querysplat_cli.scene.files import refuse_existing, with_name
from querysplat_cli.scene.formats.transforms import NamedCameras, read_cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.paths import opaque_centres
from querysplat_cli.scene.quantiles import picked
from querysplat_cli.scene.upright import up_direction

BINS = 20


@dataclass(frozen=True)
class OddPolicy:
    """What counts as odd.

    needle: the longest axis is so many times the middle one.
    giant: the longest axis is this share of the scene's extent.
    see_through: the opacity is lower.
    neighbour: which nearest neighbour measures how alone a Gaussian is.
    alone: a floater is so many times farther from that neighbour than the median Gaussian, and not see-through.
    """

    needle: float = 10.0
    giant: float = 0.1
    see_through: float = 0.05
    neighbour: int = 8
    alone: float = 20.0


ODD_POLICY = OddPolicy()


def scene_info(request: InfoRequest) -> dict[str, Any]:
    """The numbers of a scene, as --json prints them; draws them if asked to.

    Raises QuerySplatError when the scene cannot be read or the drawing cannot be made.
    """
    if request.plot:
        check_drawing(request.plot)
        refuse_existing([request.plot], force=request.force)
    path = with_name(request.scene)
    file, cameras = file_of_scene(path), folder_of_scene(path) / "cameras.json"
    gaussians = read_gaussians(file)
    inputs = read_cameras(cameras)[0] if cameras.is_file() else None
    behind = backdrop_of(folder_of_scene(path), len(gaussians))
    found = {"file": str(file), "bytes": bytes_of(file), **describe(gaussians, inputs, behind)}
    if request.plot:
        draw_info(request.plot, gaussians, found)
    return found


def describe(gaussians: Gaussians, inputs: NamedCameras | None, backdrop: int = 0) -> dict[str, Any]:
    """Everything about the Gaussians that needs no file. Lengths are in scene units, angles in degrees.

    The last `backdrop` Gaussians stand behind everything (`queries/backdrop.py`). They count as Gaussians only, unless
    there are no others.
    """
    count = len(gaussians)
    gaussians = gaussians[: count - backdrop or count]
    # In float64: squares of coordinates from 1e19 on are beyond float32.
    low, high = _box(opaque_centres(gaussians).double(), 0.05)
    extent = float((high - low).norm())
    longest = gaussians.scales.amax(1)
    odd = _odd(gaussians, extent)
    return {
        "gaussians": count,
        "backdrop": backdrop,
        "sh_degree": gaussians.sh_degree,
        "extent": {
            "diagonal": extent,
            "low": low.tolist(),
            "high": high.tolist(),
            "all": [side.tolist() for side in _box(gaussians.means, 0.0)],
        },
        "opacity": {"quantiles": quantiles(gaussians.opacities), **_histogram(gaussians.opacities, (0.0, 1.0))},
        "size": {"quantiles": quantiles(longest), **_log_histogram(longest)},
        "orientation": _orientation(inputs),
        "cameras": len(inputs.names) if inputs else None,
        "odd": {
            name: {"count": int(rows.sum()), "share": round(float(rows.double().mean()), 5)}
            for name, rows in odd.items()
        },
    }


def _box(points: Tensor, left_out: float) -> tuple[Tensor, Tensor]:
    """Corners of the box that holds all points but the share `left_out` at either end of every axis."""
    low, high = picked(points, left_out, 1 - left_out)
    return low, high


def _odd(gaussians: Gaussians, extent: float) -> dict[str, Tensor]:
    ordered = gaussians.scales.sort(1, descending=True).values
    faint = gaussians.opacities < ODD_POLICY.see_through
    return {
        "needles": ordered[:, 0] > ODD_POLICY.needle * ordered[:, 1],
        "giants": ordered[:, 0] > ODD_POLICY.giant * extent,
        "see_through": faint,
        "floaters": ~faint & _alone(gaussians.means),
    }


def _alone(means: Tensor) -> Tensor:
    """Which centres are far from their neighbours."""
    places = means.double().numpy()
    nearest = min(ODD_POLICY.neighbour, len(places) - 1)
    if nearest < 1:
        return torch.zeros(len(places), dtype=torch.bool)
    distance = cKDTree(places).query(places, [nearest + 1])[0][:, 0]  # the first is the point itself
    return torch.from_numpy(distance > ODD_POLICY.alone * np.median(distance))


def _orientation(inputs: NamedCameras | None) -> dict[str, Any]:
    """Where up is by the photos, and how far that is from −y, the up of viewers."""
    if inputs is None:
        return {"up": None, "tilt": None}
    up = up_direction(inputs.cameras)
    return {"up": up.tolist(), "tilt": float(np.degrees(np.arccos(np.clip(-up[1], -1, 1))))}


def _histogram(values: Tensor, limits: tuple[float, float]) -> dict[str, Any]:
    counts, edges = np.histogram(values.double().numpy(), BINS, limits)
    return {"counts": counts.tolist(), "edges": edges.tolist()}


def _log_histogram(values: Tensor) -> dict[str, Any]:
    """A histogram with bins that are equally wide on a logarithmic scale."""
    logs = values.clamp_min(1e-12).double().log10()
    found = _histogram(logs, (float(logs.min()), float(logs.max()) + 1e-9))
    return {"counts": found["counts"], "edges": [10**edge for edge in found["edges"]]}
