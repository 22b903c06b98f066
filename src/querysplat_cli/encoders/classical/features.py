"""SIFT features of the photos, in COLMAP's database: as many as pay, spread over each photo."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap

from querysplat_cli.encoders.classical.contrast import stretch
from querysplat_cli.encoders.classical.policy import CAMERA_POLICY, MatchEffort
from querysplat_cli.scene.decoding import reduced
from querysplat_cli.scene.filed_pixels import release
from querysplat_cli.scene.masks import MASKS, resized_mask
from querysplat_cli.scene.pictures import write_picture
from querysplat_cli.scene.views import Photo


def are_large(photos: Sequence[Photo]) -> bool:
    """Whether half of the photos have features in plenty."""
    return bool(np.median([max(photo.height, photo.width) for photo in photos]) >= CAMERA_POLICY.large_photo)


def image_name(photo: int) -> str:
    return f"{photo:06d}.pgm"


def write_grey(photos: Sequence[Photo], folder: Path, size: int) -> tuple[tuple[int, int], ...]:
    """Write the photos as grey pictures of a longer side of at most `size`, and return their sizes."""
    sizes = []
    for number, photo in enumerate(photos):
        picture = stretched(reduced(cv2.cvtColor(photo.pixels, cv2.COLOR_RGB2GRAY), size))
        release(photo)
        write_picture(folder / image_name(number), picture)
        sizes.append((picture.shape[0], picture.shape[1]))
    return tuple(sizes)


def stretched(picture: np.ndarray) -> np.ndarray:
    """A grey picture, 8-bit, with the usual contrast where it has little: one that is dark, or taken in fog."""
    found = stretch(picture, CAMERA_POLICY.little_contrast, CAMERA_POLICY.usual_contrast)
    if found is None:
        return picture
    low, factor = found
    return np.asarray((factor * (picture - low)).round().clip(0, 255).astype(np.uint8))


def write_masks(photos: Sequence[Photo], sizes: Sequence[tuple[int, int]], folder: Path) -> None:
    """Write the masks of the photos for COLMAP, beside the grey pictures, if any photo has one."""
    if all(photo.mask is None for photo in photos):
        return
    for number, (photo, (height, width)) in enumerate(zip(photos, sizes, strict=True)):
        shown = np.ones((height, width), bool) if photo.mask is None else resized_mask(photo.mask, height, width)
        write_picture(_mask_file(folder, number), shown.astype(np.uint8) * 255)


def takes_part(folder: Path, photo: int, points: np.ndarray) -> np.ndarray:
    """Which of the points [n, 2], in pixels of a photo's grey picture, lie inside its mask."""
    if not _mask_file(folder, photo).is_file():
        return np.ones(len(points), bool)
    shown = np.asarray(cv2.imread(str(_mask_file(folder, photo)), cv2.IMREAD_GRAYSCALE))
    column, row = np.clip(points.astype(np.int64), 0, np.array(shown.shape[::-1]) - 1).T
    return np.asarray(shown[row, column] > 0)


def _mask_file(folder: Path, photo: int) -> Path:
    return folder / MASKS / f"{image_name(photo)}.png"


def extract_features(database: Path, folder: Path, effort: MatchEffort) -> None:
    """Search all photos of the database, whose pictures are in `folder`, and keep at most `effort.most_features` each.

    Where half of the photos have less than half of these, all are searched again at twice the resolution.
    """
    _search(database, folder, effort)
    if effort.most_features is None:
        return
    with pycolmap.Database.open(database) as store:
        images = sorted(image.image_id for image in store.read_all_images())
        counts = [store.num_keypoints_for_image(image) for image in images]
        again = effort.first_octave >= 0 and np.median(counts) < effort.most_features / 2
        if again:
            store.clear_keypoints()
            store.clear_descriptors()
    if again:
        _search(database, folder, replace(effort, first_octave=-1))
    with pycolmap.Database.open(database) as store:
        _keep_spread(store, images, effort.most_features)


def _search(database: Path, folder: Path, effort: MatchEffort) -> None:
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False
    options.sift.first_octave = effort.first_octave
    options.sift.estimate_affine_shape = options.sift.domain_size_pooling = effort.affine
    if effort.peak_threshold is not None:
        options.sift.peak_threshold = effort.peak_threshold
    if effort.most_found is not None:
        options.sift.max_num_features = effort.most_found
    reader = pycolmap.ImageReaderOptions()
    if (folder / MASKS).is_dir():
        reader.mask_path = folder / MASKS
    pycolmap.extract_features(database, folder, reader_options=reader, extraction_options=options)


def _keep_spread(store: pycolmap.Database, images: Sequence[int], most: int) -> None:
    """Keep at most `most` features of each image in the database, spread over the image."""
    kept = []
    for image in images:
        keypoints, descriptors = store.read_keypoints(image), store.read_descriptors(image)
        rows = spread_features(keypoints, most)
        descriptors.data = np.ascontiguousarray(descriptors.data[rows])
        kept.append((image, np.ascontiguousarray(keypoints[rows]), descriptors))
    store.clear_keypoints()
    store.clear_descriptors()
    for image, keypoints, descriptors in kept:
        store.write_keypoints(image, keypoints)
        store.write_descriptors(image, descriptors)


def spread_features(keypoints: np.ndarray, most: int) -> np.ndarray:
    """Rows, ascending, of at most `most` of the keypoints [n, 4 or 6] of a photo: the largest of each cell of a grid.

    A cell gives its second feature only when every cell has given its first, and so on.
    """
    if len(keypoints) <= most:
        return np.arange(len(keypoints))
    position, size = keypoints[:, :2], feature_sizes(keypoints)
    low, high = position.min(0), position.max(0)
    cells = CAMERA_POLICY.spread_cells
    column, row = np.minimum((position - low) / np.maximum(high - low, 1e-6) * cells, cells - 1).astype(np.int64).T
    cell = row * cells + column
    order = np.lexsort((-size, cell))
    starts = np.searchsorted(cell[order], np.arange(cells * cells))
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order)) - starts[cell[order]]
    return np.sort(np.lexsort((-size, rank))[:most])


def feature_sizes(keypoints: np.ndarray) -> np.ndarray:
    """The scales [n] of COLMAP's keypoints: circles [n, 4], or affine shapes [n, 6]."""
    return np.asarray(np.hypot(keypoints[:, 2], keypoints[:, 4]) if keypoints.shape[1] == 6 else keypoints[:, 2])
