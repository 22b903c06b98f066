"""Warnings about a model that looks complete.

The number of placed photos and the reprojection error are not enough. The global mapper once placed all photos of
`fox` with an error of 0.3 px, and the cameras were wrong by 30 % of the scene's extent.
"""

from itertools import pairwise

import numpy as np

from querysplat_cli.encoders.classical.epipolar import epipolar_support
from querysplat_cli.encoders.classical.focal_from_lines import told_by_lines
from querysplat_cli.encoders.classical.matches import Matches
from querysplat_cli.encoders.classical.policy import CAMERA_POLICY
from querysplat_cli.encoders.classical.sparse_model import SparseModel
from querysplat_cli.scene.cameras import PhotoCamera


def camera_warnings(model: SparseModel, matches: Matches, *, known: bool = False) -> tuple[str, ...]:
    """Sentences that say why the cameras may be wrong. Empty when every check passes.

    `known` cameras were given: how well photos determine them does not matter then.
    """
    policy = CAMERA_POLICY
    support = epipolar_support(model, matches)
    angle = median_angle(model)
    sentences = [
        (
            support.share < policy.agreeing_share,
            f"only {support.share:.0%} of the matches between photos agree with the cameras, which may be wrong",
        ),
        (
            support.coverage < policy.covered_share or len(model.points) < policy.few_points,
            f"only {len(model.points)} points tie the cameras together, which may be wrong",
        ),
        (
            len(model.points) > 0 and angle < policy.small_angle,
            f"the camera hardly moved (rays meet at {angle:.1f}°), so depth is uncertain",
        ),
        (
            not known and is_flat(model) and not all(matches.focals[photo] for photo in model.cameras),
            "all matched points lie in one plane, which leaves the focal length and the cameras' tilt uncertain",
        ),
        (is_forward(model), "the camera moved along its viewing direction, where depth is hardest to measure"),
        *_focal_warnings(model, matches, known=known),
        *_behind(model),
    ]
    return tuple(text for applies, text in sentences if applies)


def median_angle(model: SparseModel) -> float:
    """The median angle in degrees between the rays of a point: from its first camera and the one farthest from that."""
    first = np.full((len(model.points), 3), np.nan)
    smallest = np.ones(len(model.points))
    for photo, rows in model.seen.items():
        rays = model.points[rows] - model.centre(photo)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        new = np.isnan(first[rows, 0])
        first[rows[new]] = rays[new]
        smallest[rows] = np.minimum(smallest[rows], (first[rows] * rays).sum(1))
    return float(np.degrees(np.median(np.arccos(np.clip(smallest, -1, 1))))) if len(first) else 0.0


def is_flat(model: SparseModel) -> bool:
    """Whether nearly all points lie in one plane."""
    if len(model.points) < 4:
        return True
    offset = model.points - np.median(model.points, axis=0)
    distance = np.linalg.norm(offset, axis=1)
    near = offset[distance <= np.quantile(distance, 0.9)]
    near = near - near.mean(0)
    _, axes = np.linalg.eigh(near.T @ near)
    thickness, width, _ = np.quantile(np.abs(near @ axes), 0.8, axis=0)
    return bool(thickness <= CAMERA_POLICY.flat_thickness * width)


def is_forward(model: SparseModel) -> bool:
    """Whether most steps from photo to photo run along the viewing direction."""
    order = list(model.cameras)
    cosines = []
    for one, two in pairwise(order):
        step = model.centre(two) - model.centre(one)
        axis = model.cameras[one].w2c[2, :3]
        cosines.append(abs(step @ axis) / max(float(np.linalg.norm(step)), 1e-12))
    return bool(cosines) and float(np.median(cosines)) > CAMERA_POLICY.forward_cosine


def has_ordinary_lens(model: SparseModel) -> bool:
    """Whether every photo spans an angle that ordinary lenses have."""
    low, high = CAMERA_POLICY.field_of_view
    return all(low <= field_of_view(camera) <= high for camera in model.cameras.values())


def field_of_view(camera: PhotoCamera) -> float:
    """Degrees along the longer side."""
    return float(np.degrees(2 * np.arctan(max(camera.height, camera.width) / max(camera.focal) / 2)))


def exif_ratios(model: SparseModel, matches: Matches) -> list[float]:
    """Focal lengths over those that EXIF states, of the photos where it does."""
    stated = ((camera.focal[0], matches.focals[photo]) for photo, camera in model.cameras.items())
    return [found / exif for found, exif in stated if exif]


def _focal_warnings(model: SparseModel, matches: Matches, *, known: bool) -> list[tuple[bool, str]]:
    fields = [field_of_view(camera) for camera in model.cameras.values()]
    ratios = exif_ratios(model, matches)
    furthest = max((ratio - 1 for ratio in ratios), key=abs, default=0.0)
    return [
        (
            not has_ordinary_lens(model),
            f"the photos seem to span {min(fields):.0f}° to {max(fields):.0f}°, unusual for a lens",
        ),
        (
            not known and len(model.cameras) == 2 and not ratios and not _lines_tell(model, matches),
            "two photos without a stated focal length hardly determine it, so proportions in depth may be wrong",
        ),
        (
            abs(furthest) > CAMERA_POLICY.exif_difference,
            f"the focal length found differs by {furthest:+.0%} from the one that the photos state",
        ),
    ]


def _lines_tell(model: SparseModel, matches: Matches) -> bool:
    return all(told_by_lines(matches.expected_focals[photo]) for photo in model.cameras)


def _behind(model: SparseModel) -> list[tuple[bool, str]]:
    depths = np.concatenate([model.depths(photo) for photo in model.cameras])
    share = float(np.mean(depths <= 0)) if len(depths) else 0.0
    return [(share > CAMERA_POLICY.behind_share, f"{share:.0%} of the points lie behind the cameras that observe them")]
