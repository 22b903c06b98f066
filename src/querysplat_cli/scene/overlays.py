"""Overlays: text, logos, date stamps, frames and bars that lie over the photos and stay where they are.

An overlay has the same edges at the same pixels of all photos, while the scene moves behind it. Structure from motion
would take it for a scene that a resting camera sees, and a scene would hold a copy of it before every camera.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from querysplat_cli.scene.decoding import reduced
from querysplat_cli.scene.filed_pixels import release
from querysplat_cli.scene.masks import Overlay
from querysplat_cli.scene.policy import OVERLAY_POLICY
from querysplat_cli.scene.views import Photo


@dataclass(frozen=True)
class Overlaid:
    """How many photos have an overlay, and which share of the pixels of all photos lies under it."""

    photos: int
    share: float


def without_overlays(photos: Sequence[Photo]) -> tuple[list[Photo], Overlaid | None]:
    """The photos with what an overlay covers masked, and what was found; None where there is none.

    Photos of one size are looked at together, where there are at least five.
    """
    found, covered = list(photos), []
    sizes = [(photo.height, photo.width) for photo in photos]
    for size in dict.fromkeys(sizes):
        rows = [row for row, other in enumerate(sizes) if other == size]
        overlay = find_overlay(_pictures([photos[row] for row in rows]))
        if overlay:
            covered += [1 - float(overlay.shown(*size).mean())] * len(rows)
            for row in rows:
                found[row] = photos[row].under(overlay)
    return found, Overlaid(len(covered), sum(covered) / len(photos)) if covered else None


def _pictures(photos: Sequence[Photo]) -> list[np.ndarray]:
    """Small copies of some of the photos, evenly spaced; none where there are too few."""
    if len(photos) < OVERLAY_POLICY.fewest:
        return []
    count = min(len(photos), OVERLAY_POLICY.most)
    some = [photos[row] for row in np.linspace(0, len(photos) - 1, count).round().astype(int)]
    pictures = []
    for photo in some:
        pictures.append(reduced(photo.pixels, OVERLAY_POLICY.size))
        release(photo)
    return pictures


def find_overlay(pictures: Sequence[np.ndarray]) -> Overlay | None:
    """What stays where it is in all of the pictures [height, width, 3], 8-bit and of one size; None where nothing does.

    Where most edges stay, the camera hardly moved, and nothing is an overlay.
    """
    if not pictures:
        return None
    policy = OVERLAY_POLICY
    gradients = np.stack([_gradients(picture) for picture in pictures])
    mean = gradients.mean(0)
    clear, strength = _lengths(mean), np.mean([_lengths(each) for each in gradients], 0)
    alike = np.mean([_lengths(each - mean) < policy.deviation * clear for each in gradients], 0) >= policy.agreeing
    if len(pictures) >= policy.enough:
        alike |= clear > policy.coherent * strength
    still = _registered((alike & (clear > policy.least_gradient)).any(-1), gradients, mean)
    if not still.any() or still.sum() > policy.most_edges * (strength > policy.least_gradient).any(-1).sum():
        return None
    around = cv2.dilate(still.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    return Overlay(_boxes(around | _enclosed(around, pictures)))


def _lengths(vectors: Float[np.ndarray, "... 2"]) -> Float[np.ndarray, "..."]:
    return np.hypot(vectors[..., 0], vectors[..., 1])


def _gradients(picture: np.ndarray) -> Float[np.ndarray, "height width 3 2"]:
    """Of each colour along x and y, in grey levels per pixel."""
    along = [cv2.Sobel(picture, cv2.CV_32F, dx, dy, ksize=3, scale=1 / 8) for dx, dy in ((1, 0), (0, 1))]
    return np.stack(along, -1)


def _registered(
    still: Bool[np.ndarray, "height width"],
    gradients: Float[np.ndarray, "pictures height width 3 2"],
    mean: Float[np.ndarray, "height width 3 2"],
) -> Bool[np.ndarray, "height width"]:
    """Those connected edges whose gradients fit each picture best where they are, and not a few pixels aside.

    Far things move little from photo to photo, but they move.
    """
    policy = OVERLAY_POLICY
    closed = cv2.morphologyEx(still.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((policy.gap, policy.gap), np.uint8))
    count, labels = cv2.connectedComponents(closed)
    kept = np.zeros_like(still)
    steps = range(-policy.aside, policy.aside + 1)
    height, width = still.shape
    fewest = policy.fewest_edges * max(1.0, policy.enough / len(gradients)) ** 3
    for label in range(1, count):
        rows, columns = np.nonzero((labels == label) & still)
        if len(rows) < fewest:
            continue
        expected = mean[rows, columns]
        fits = np.zeros((len(steps), len(steps), len(gradients)))
        for i, dy in enumerate(steps):
            for j, dx in enumerate(steps):
                there = gradients[:, np.clip(rows + dy, 0, height - 1), np.clip(columns + dx, 0, width - 1)]
                fits[i, j] = _cosines(there, expected)
        here = fits[policy.aside, policy.aside]
        across = np.ptp(rows) >= policy.across * height or np.ptp(columns) >= policy.across * width
        best = (here >= (policy.tied if across else 1.0) * fits.max((0, 1))).mean()
        if best >= policy.registered and np.median(here) >= policy.alike:
            kept[rows, columns] = True
    return kept


def _cosines(found: Float[np.ndarray, "pictures n 3 2"], expected: Float[np.ndarray, "n 3 2"]) -> np.ndarray:
    products = np.einsum("pnck,nck->p", found, expected)
    return np.asarray(products / np.sqrt((found**2).sum((1, 2, 3)) * (expected**2).sum() + 1e-9))


def _enclosed(around: Bool[np.ndarray, "height width"], pictures: Sequence[np.ndarray]) -> Bool[np.ndarray, "h w"]:
    """Areas of a colour that is the same in all pictures, between the edges of an overlay, such as bars and logos."""
    policy = OVERLAY_POLICY
    span = np.ptp(np.stack(pictures), axis=0).max(-1)
    count, labels = cv2.connectedComponents(((span <= policy.same_colour) & ~around).astype(np.uint8), connectivity=4)
    found = np.zeros_like(around)
    for label in range(1, count):
        area = labels == label
        border = (cv2.dilate(area.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0) & ~area
        if border.any() and around[border].mean() >= policy.enclosed:
            found |= area
    return found


def _boxes(covered: Bool[np.ndarray, "height width"]) -> tuple[tuple[float, float, float, float], ...]:
    """Boxes of whole cells that hold all that is covered, in widths of the picture: runs of cells, joined downwards."""
    height, width = covered.shape
    cell = OVERLAY_POLICY.cell
    padded = np.pad(covered, ((0, -height % cell), (0, -width % cell)))
    cells = padded.reshape(padded.shape[0] // cell, cell, -1, cell).any((1, 3))
    began: dict[tuple[int, int], int] = {}
    boxes: list[tuple[int, int, int, int]] = []
    for row, line in enumerate(np.pad(cells, ((0, 1), (0, 0)))):
        edges = np.flatnonzero(np.diff(np.pad(line, 1).astype(np.int8))).tolist()
        runs = list(zip(edges[::2], edges[1::2], strict=True))
        boxes += [(left, top, right, row) for (left, right), top in began.items() if (left, right) not in runs]
        began = {run: began.get(run, row) for run in runs}

    def widths(edge: int) -> float:
        return round(edge * cell / width, 6)

    return tuple((widths(left), widths(top), widths(right), widths(bottom)) for left, top, right, bottom in boxes)
