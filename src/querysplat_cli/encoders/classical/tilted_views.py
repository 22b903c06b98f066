"""Matches of photos that were taken from very different directions, by tilting these photos (ASIFT).

SIFT follows a photo that is turned or scaled, and loses one that is seen at another slant. A slant is nearly an affine
map. So the photos that were not placed are squeezed in several directions, and what SIFT finds in these pictures is
matched with the features of the other photos (Morel & Yu, SIAM J. Imaging Sciences 2, 2009). The photos that were
placed are searched no second time.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pycolmap

from querysplat_cli.encoders.classical.append_matches import append_features, append_matches
from querysplat_cli.encoders.classical.features import extract_features, image_name, takes_part
from querysplat_cli.encoders.classical.matches import Matches, shared_cameras, write_images
from querysplat_cli.encoders.classical.policy import CAMERA_POLICY
from querysplat_cli.encoders.classical.verified_pairs import match_pairs
from querysplat_cli.scene.decoding import reduced
from querysplat_cli.scene.pictures import write_picture


@dataclass(frozen=True)
class TiltedView:
    """A squeezed picture of a photo, of `size` (height, width). `to_photo` [2, 3] maps its pixels to the photo's.

    Its file and its image in the database have the name of a photo of this `number`.
    """

    photo: int
    number: int
    size: tuple[int, int]
    to_photo: np.ndarray


def with_tilted_views(matches: Matches, weak: Sequence[int], *, seed: int) -> Matches:
    """The matches, and more between each of the `weak` photos and all others, in the same folder and database.

    Features of the tilted views are appended to those of their photos, and the changed pairs are verified again. A
    feature of the other photo is matched once at most, so that no correspondence counts twice.
    """
    folder = matches.folder / "tilted"
    folder.mkdir()
    views = _write_views(matches, weak, folder)
    found = _matched_views(matches, views, folder)
    with pycolmap.Database.open(matches.database) as store:
        changed = _append(store, found)
    return matches.verified_again(changed, CAMERA_POLICY.tilted, seed)


def tilted(grey: np.ndarray, tilt: float, degrees: float) -> tuple[np.ndarray, np.ndarray]:
    """The picture turned by `degrees` and then squeezed to 1 / `tilt` of its width, and the map [2, 3] back.

    The map takes pixels of the new picture, which holds the whole old one, to the old one's; centres are at +0.5.
    """
    height, width = grey.shape
    angle = np.radians(degrees)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    corners = turn @ np.array([[0, width, 0, width], [0, 0, height, height]], float)
    low, full = corners.min(1), np.ceil(np.ptp(corners, axis=1)).astype(int)
    turned = cv2.warpAffine(grey, _opencv(turn, -low), full.tolist(), borderMode=cv2.BORDER_REFLECT_101)
    if tilt > 1:
        # Along the squeezed axis the picture must lose what the fewer pixels cannot hold.
        turned = cv2.GaussianBlur(turned, (0, 0), 0.8 * np.sqrt(tilt**2 - 1), sigmaY=1e-3)
    squeeze = np.diag([1 / tilt, 1.0])
    size = [int(np.ceil(full[0] / tilt)), int(full[1])]
    picture = cv2.warpAffine(turned, _opencv(squeeze, np.zeros(2)), size, borderMode=cv2.BORDER_REFLECT_101)
    back = turn.T @ np.linalg.inv(squeeze)
    return picture, np.column_stack([back, turn.T @ low])


def _opencv(linear: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """A map of pixels with centres at +0.5, for OpenCV, which has them at whole numbers."""
    return np.column_stack([linear, linear @ [0.5, 0.5] + shift - 0.5])


def _write_views(matches: Matches, weak: Sequence[int], folder: Path) -> list[TiltedView]:
    views: list[TiltedView] = []
    size = CAMERA_POLICY.tilted.feature_size
    for photo in weak:
        grey = np.asarray(cv2.imread(str(matches.folder / image_name(photo)), cv2.IMREAD_GRAYSCALE))
        height, width = grey.shape
        small = reduced(grey, size)
        enlarge = np.array([[width / small.shape[1]], [height / small.shape[0]]])
        for tilt, degrees in CAMERA_POLICY.tilts:
            picture, back = tilted(small, tilt, degrees)
            view = TiltedView(photo, len(matches.sizes) + len(views), picture.shape, enlarge * back)
            write_picture(folder / image_name(view.number), picture)
            views.append(view)
    return views


@dataclass(frozen=True)
class _Found:
    """Features of a photo's view [n, 6], as COLMAP's keypoints of the photo, matched with those of another photo."""

    photo: int
    other: int
    keypoints: np.ndarray
    partners: np.ndarray


def _matched_views(matches: Matches, views: Sequence[TiltedView], folder: Path) -> list[_Found]:
    """For each view and other photo, the features that match, in a database of their own."""
    photos, effort, database = len(matches.sizes), CAMERA_POLICY.tilted, folder / "matches.db"
    sizes = [*matches.sizes, *(view.size for view in views)]
    with pycolmap.Database.open(database) as store:
        write_images(store, shared_cameras(sizes, [None] * len(sizes)))
    with pycolmap.Database.open(matches.database) as source, pycolmap.Database.open(database) as store:
        extract_features(database, folder, effort)
        for photo in range(photos):
            store.write_keypoints(photo + 1, source.read_keypoints(photo + 1))
            store.write_descriptors(photo + 1, source.read_descriptors(photo + 1))
    pairs = [(other, view.number) for view in views for other in range(photos) if other != view.photo]
    match_pairs(database, folder, pairs, effort, None)
    found = []
    with pycolmap.Database.open(database) as store:
        for view in views:
            keypoints = _in_photo(store.read_keypoints(view.number + 1), view)
            height, width = matches.sizes[view.photo]
            inside = np.all((keypoints[:, :2] >= 0) & (keypoints[:, :2] < [width, height]), axis=1)
            inside &= takes_part(matches.folder, view.photo, keypoints[:, :2])
            for other in range(photos):
                if other != view.photo and store.exists_matches(other + 1, view.number + 1):
                    rows = store.read_matches(other + 1, view.number + 1)
                    rows = rows[inside[rows[:, 1]]]
                    found.append(_Found(view.photo, other, keypoints[rows[:, 1]], rows[:, 0]))
    return found


def _in_photo(keypoints: np.ndarray, view: TiltedView) -> np.ndarray:
    """COLMAP's keypoints [n, 6] of a view, at their places in the photo."""
    moved = keypoints.copy()
    moved[:, :2] = keypoints[:, :2] @ view.to_photo[:, :2].T + view.to_photo[:, 2]
    moved[:, 2] *= np.sqrt(abs(np.linalg.det(view.to_photo[:, :2])))
    return moved


def _append(store: pycolmap.Database, found: Sequence[_Found]) -> list[tuple[int, int]]:
    """Adds the features and their matches to the photos' own, and returns the pairs of photos that changed."""
    keypoints: dict[int, list[np.ndarray]] = {}
    matches: dict[tuple[int, int], list[np.ndarray]] = {}
    for each in found:
        new_ones = keypoints.setdefault(each.photo, [])
        first_new = store.num_keypoints_for_image(each.photo + 1) + sum(map(len, new_ones))
        new = first_new + np.arange(len(each.partners), dtype=np.uint32)
        new_ones.append(each.keypoints)
        first, second = min(each.photo, each.other), max(each.photo, each.other)
        columns = (new, each.partners) if each.photo == first else (each.partners, new)
        matches.setdefault((first, second), []).append(np.column_stack(columns))
    append_features(store, {photo: np.concatenate(parts) for photo, parts in keypoints.items()})
    return append_matches(store, {pair: np.concatenate(rows) for pair, rows in matches.items()})
