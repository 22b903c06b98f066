"""Errors between two sets of cameras of the same photos, after a similarity alignment."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch

from querysplat_cli.evaluation.policy import EVALUATION_POLICY
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.figures import check_drawing, new_figure, save_figure
from querysplat_cli.runtime.words import counted
from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.files import atomic_path
from querysplat_cli.scene.lenses import pinhole_width
from querysplat_cli.scene.match_cameras import matched_names
from querysplat_cli.scene.rotations import rotation_angles
from querysplat_cli.scene.sim3 import Sim3, align_cameras, least_squares_fit


@dataclass(frozen=True)
class PoseErrors:
    """How far the cameras of A are from those of B, in the frame and the unit of B.

    `rotation` (degrees) and `centre` (units of B) by photo, after the similarity of `align_cameras`; `ate` is the root
    mean square distance of the centres after the similarity that makes it least, as trajectories are compared, and
    `extent` the largest distance between two of B's centres. `pair_rotation` and
    `pair_translation` are the errors, in degrees, of each pair's relative rotation and of the direction (with its
    sign) from the first camera to the second; these need no alignment. `focal` is A's focal length over the picture's
    width, relative to B's, less one. Where one of a photo's two cameras is a fisheye's, the width is that of the
    pinhole view that it becomes.
    """

    names: tuple[str, ...]
    only_a: tuple[str, ...]
    only_b: tuple[str, ...]
    scale: float
    rotation: np.ndarray
    centre: np.ndarray
    ate: float
    extent: float
    pair_rotation: np.ndarray
    pair_translation: np.ndarray
    focal: np.ndarray
    centres: np.ndarray
    """Of A, moved, and of B: [2, n, 3]."""

    def summary(self) -> dict[str, Any]:
        """Medians, means and rates, for a report. Rates are per cent of pairs."""
        worse = np.maximum(self.pair_rotation, self.pair_translation)
        rates = {f"rra_{t}": _recall(self.pair_rotation, float(t)) for t in EVALUATION_POLICY.pose_thresholds}
        rates |= {f"rta_{t}": _recall(self.pair_translation, float(t)) for t in EVALUATION_POLICY.pose_thresholds}
        rates |= {f"auc_{t}": area_under_recall(worse, float(t)) for t in EVALUATION_POLICY.pose_thresholds}
        return {
            "photos": len(self.names),
            "only_a": list(self.only_a),
            "only_b": list(self.only_b),
            "scale": self.scale,
            "rotation_degrees": {"median": float(np.median(self.rotation)), "max": float(self.rotation.max())},
            "centre": {"median": float(np.median(self.centre)), "max": float(self.centre.max())},
            "ate": self.ate,
            "ate_of_extent": self.ate / self.extent,
            **{key: 100 * value for key, value in rates.items()},
            "focal_error": {"median": float(np.median(self.focal)), "max_abs": float(np.abs(self.focal).max())},
            "views": {
                name: {"rotation_degrees": float(turn), "centre": float(shift), "focal_error": float(focal)}
                for name, turn, shift, focal in zip(self.names, self.rotation, self.centre, self.focal, strict=True)
            },
        }


def compare_cameras(a: Mapping[str, PhotoCamera], b: Mapping[str, PhotoCamera]) -> PoseErrors:
    """Errors of `a` against `b`, whose photos are paired as `matched_names` does.

    Raises QuerySplatError when fewer than two photos are in both, and DegenerateAlignment when these do not fix a
    similarity.
    """
    shared = matched_names({name: PurePosixPath(camera.file or name) for name, camera in a.items()}, b)
    if len(shared) < 2:
        only_a, only_b = (
            next((name for name in side if name not in paired), "no other")
            for side, paired in ((a, shared.keys()), (b, shared.values()))
        )
        raise QuerySplatError(
            f"{counted(len(shared), 'photo')} in both sets of cameras, and two are needed",
            f"Names must agree: one has {only_a}, the other {only_b}.",
        )
    mine, theirs = [a[name] for name in shared], [b[name] for name in shared.values()]
    w2c_a, w2c_b = (np.stack([camera.w2c for camera in side]) for side in (mine, theirs))
    similarity = align_cameras(torch.from_numpy(w2c_a), torch.from_numpy(w2c_b))
    centres_a, centres_b = _transformed(_centres(w2c_a), similarity), _centres(w2c_b)
    turned = w2c_a[:, :3, :3] @ similarity.rotation.numpy().T
    distance = np.linalg.norm(centres_a - centres_b, axis=1)
    _, left = least_squares_fit(_centres(w2c_a), centres_b, np.ones(len(shared)))
    apart = np.linalg.norm(centres_b[:, None] - centres_b[None], axis=2)
    pairs = np.array(list(combinations(range(len(shared)), 2)))
    return PoseErrors(
        names=tuple(shared.values()),
        only_a=tuple(name for name in a if name not in shared),
        only_b=tuple(name for name in b if name not in set(shared.values())),
        scale=similarity.scale,
        rotation=_angles(turned @ w2c_b[:, :3, :3].swapaxes(1, 2)),
        centre=distance,
        ate=float(np.sqrt(np.mean(left**2))),
        extent=float(apart.max()),
        pair_rotation=_pair_rotation(w2c_a, w2c_b, pairs),
        pair_translation=_between(_pair_direction(w2c_a, pairs), _pair_direction(w2c_b, pairs)),
        focal=np.array([_focal_error(one, other) for one, other in zip(mine, theirs, strict=True)]),
        centres=np.stack([centres_a, centres_b]),
    )


def area_under_recall(errors: np.ndarray, threshold: float) -> float:
    """The mean, over thresholds from 0 to `threshold`, of the share of errors below them; exact, without bins."""
    return float(np.clip(1 - errors / threshold, 0, None).mean())


def draw_trajectories(errors: PoseErrors, file: Path, titles: Sequence[str]) -> None:
    """Both trajectories from the side from which they are widest, and each photo's errors; PNG, SVG or PDF.

    Raises QuerySplatError for another suffix.
    """
    check_drawing(file)
    figure = new_figure(9.0, 4.2)
    plan, side = figure.subplots(1, 2, width_ratios=(1.3, 1))
    middle = errors.centres[1].mean(0)
    axes = np.linalg.svd(errors.centres[1] - middle)[2][:2]
    flat = (errors.centres - middle) @ axes.T
    for track, title, style in zip(flat, titles, ("o-", "x--"), strict=True):
        plan.plot(*track.T, style, ms=4, lw=0.8, label=title)
    plan.plot(*flat.transpose(2, 0, 1), color="grey", lw=0.5)
    plan.set_aspect("equal", "datalim")
    plan.legend(fontsize=8)
    plan.set_title(f"{len(errors.names)} camera centres, in units of {titles[1]}", fontsize=9)
    photos = np.arange(len(errors.names))
    side.plot(photos, errors.rotation, label="rotation, degrees")
    side.plot(photos, 100 * errors.centre / errors.extent, label="centre, % of the extent")
    side.set_xlabel("photo")
    side.set_ylim(bottom=0)
    side.legend(fontsize=8)
    with atomic_path(file) as draft:
        save_figure(figure, draft)


def _recall(errors: np.ndarray, threshold: float) -> float:
    return float((errors < threshold).mean())


def _centres(w2c: np.ndarray) -> np.ndarray:
    return -np.einsum("nji,nj->ni", w2c[:, :3, :3], w2c[:, :3, 3])


def _transformed(points: np.ndarray, similarity: Sim3) -> np.ndarray:
    return np.asarray(similarity.apply(torch.from_numpy(points)).numpy())


def _angles(rotations: np.ndarray) -> np.ndarray:
    return np.asarray(rotation_angles(torch.from_numpy(rotations)).numpy())


def _pair_rotation(a: np.ndarray, b: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    relative = [side[pairs[:, 1], :3, :3] @ side[pairs[:, 0], :3, :3].swapaxes(1, 2) for side in (a, b)]
    return _angles(relative[0] @ relative[1].swapaxes(1, 2))


def _pair_direction(w2c: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """From the first camera of each pair to the second, in the first one's axes [n, 3]; not of unit length."""
    first, centres = w2c[pairs[:, 0]], _centres(w2c)
    return np.einsum("nij,nj->ni", first[:, :3, :3], centres[pairs[:, 1]] - centres[pairs[:, 0]])


def _between(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Angles between vectors in degrees; 180 where one has no length and so no direction, 0 where both have none."""
    sine, cosine = np.linalg.norm(np.cross(one, other), axis=1), (one * other).sum(1)
    lost = (np.linalg.norm(one, axis=1) == 0) != (np.linalg.norm(other, axis=1) == 0)
    return np.where(lost, 180.0, np.degrees(np.arctan2(sine, cosine)))


def _focal_error(one: PhotoCamera, other: PhotoCamera) -> float:
    as_views = one.fisheye != other.fisheye  # the other one is a pinhole view's, as `reconstruct` makes it
    return _focal(one, as_views) / _focal(other, as_views) - 1


def _focal(camera: PhotoCamera, as_view: bool) -> float:
    width = pinhole_width(camera) if as_view and camera.fisheye else camera.width
    return float(np.sqrt(camera.focal[0] * camera.focal[1])) / width
