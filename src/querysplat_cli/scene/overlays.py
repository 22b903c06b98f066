"""Overlays: what stays where it is in all photos, while the rest moves.

These are text, logos, date stamps, frames and bars that lie over the photos, and the surroundings of a turntable before
a resting camera. An overlay has the same edges at the same pixels of all photos. Structure from motion would take it
for a scene that a resting camera sees, and a scene would hold a copy of it before every camera.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from querysplat_cli.runtime.sequences import evenly_spaced
from querysplat_cli.scene.decoding import reduced
from querysplat_cli.scene.filed_pixels import release
from querysplat_cli.scene.masks import MaskedShare, Overlay, spread
from querysplat_cli.scene.policy import OVERLAY_POLICY
from querysplat_cli.scene.views import Photo

Place = tuple[slice, slice]
"""Rows and columns of a part of a picture."""


@dataclass(frozen=True)
class StaticPart:
    """What stays where it is.

    covered: its pixels.
    steady: those that have their median colour, `usual`, in most pictures.
    edges: the pixels of its edges, whose mean gradients are `expected`.
    """

    covered: Bool[np.ndarray, "height width"]
    steady: Bool[np.ndarray, "height width"]
    usual: Float[np.ndarray, "height width 3"]
    edges: Bool[np.ndarray, "height width"]
    expected: Float[np.ndarray, "height width 3 2"]

    def overlay(self, picture: np.ndarray) -> Overlay:
        """What it covers in one picture of this size: not where something stands before it."""
        return Overlay(_boxes(self.covered & ~spread(cv2.MORPH_DILATE, self._before(picture), OVERLAY_POLICY.gap)))

    def _before(self, picture: np.ndarray) -> Bool[np.ndarray, "height width"]:
        """Where steady pixels have another colour and the edges are gone. What is half transparent keeps its edges."""
        policy = OVERLAY_POLICY
        other = (np.abs(picture - self.usual).max(-1) > 2 * policy.same_colour) & self.steady & self.covered
        large = spread(cv2.MORPH_OPEN, spread(cv2.MORPH_CLOSE, other, policy.before), policy.before)
        gradients, found = _gradients(picture), np.zeros_like(large)
        for place, part in _parts(large):
            edges = part & self.edges[place]
            if _cosines(gradients[place][edges][None], self.expected[place][edges])[0] < policy.gone:
                found[place] |= part
        return found


def without_overlays(photos: Sequence[Photo]) -> tuple[list[Photo], MaskedShare | None]:
    """The photos with what an overlay covers masked, and what was found; None where there is none.

    Photos of one size are looked at together, where there are at least five.
    """
    found, covered = list(photos), []
    sizes = [(photo.height, photo.width) for photo in photos]
    for size in dict.fromkeys(sizes):
        rows = [row for row, other in enumerate(sizes) if other == size]
        static = _static_part([photos[row] for row in rows])
        if not static:
            continue
        for row in rows:
            overlay = static.overlay(_picture(photos[row]))
            covered.append(1 - float(overlay.shown(*size).mean()))
            found[row] = photos[row].under(overlay)
    return found, MaskedShare(len(covered), sum(covered) / len(photos)) if covered else None


def _static_part(photos: Sequence[Photo]) -> StaticPart | None:
    """That of some of the photos, evenly spaced; None where there are too few that differ.

    Copies say the same thing twice: a few places, each photographed or saved several times, agree by chance.
    """
    if len(photos) < OVERLAY_POLICY.fewest:
        return None
    pictures = [_picture(photo) for photo in evenly_spaced(photos, OVERLAY_POLICY.most)]
    part = find_static_part(pictures)
    different = _different(pictures) if part else pictures
    if len(different) == len(pictures):
        return part
    return find_static_part(different) if len(different) >= OVERLAY_POLICY.fewest else None


def _different(pictures: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Those that are no copy of an earlier one: saved anew, or taken from the same place."""
    found: list[tuple[np.ndarray, np.ndarray]] = []
    for picture in pictures:
        gradients = _gradients(reduced(picture, OVERLAY_POLICY.copy_size))
        if all(_alike(gradients, other) < OVERLAY_POLICY.copies for _, other in found):
            found.append((picture, gradients))
    return [picture for picture, _ in found]


def _alike(one: Float[np.ndarray, "height width 3 2"], other: Float[np.ndarray, "height width 3 2"]) -> float:
    """Share of the edges of two pictures of one size that both have at the same place."""
    policy = OVERLAY_POLICY
    mean = (one + other) / 2
    clear, strength = _lengths(mean), (_lengths(one) + _lengths(other)) / 2
    both = (_lengths(one - mean) < policy.deviation * clear) & (clear > policy.least_gradient)
    edges = (strength > policy.least_gradient).any(-1)
    return float(both.any(-1).sum() / max(edges.sum(), 1))


def _picture(photo: Photo) -> np.ndarray:
    """A small copy."""
    picture = reduced(photo.pixels, OVERLAY_POLICY.size)
    release(photo)
    return picture


def find_static_part(pictures: Sequence[np.ndarray]) -> StaticPart | None:
    """What stays where it is in all of the pictures [height, width, 3], 8-bit and of one size; None where nothing does.

    Where most edges stay, the camera hardly moved, and nothing is static.
    """
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
    around = spread(cv2.MORPH_DILATE, still, policy.around)
    usual = np.median(np.stack(pictures), 0)
    near = [np.abs(picture - usual).max(-1) <= policy.same_colour for picture in pictures]
    steady = np.mean(near, 0) >= policy.steady
    return StaticPart(around | _enclosed(around, steady), steady, usual, still, mean)


def _parts(area: Bool[np.ndarray, "height width"], connectivity: int = 8) -> Iterator[tuple[Place, np.ndarray]]:
    """The connected parts of an area, each as the place of its box with a pixel around it, and its pixels there."""
    _, labels, boxes, _ = cv2.connectedComponentsWithStats(area.astype(np.uint8), connectivity=connectivity)
    for label, (left, top, width, height, _) in enumerate(boxes[1:].tolist(), 1):
        place = slice(max(top - 1, 0), top + height + 1), slice(max(left - 1, 0), left + width + 1)
        yield place, labels[place] == label


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
    kept = np.zeros_like(still)
    steps = range(-policy.aside, policy.aside + 1)
    height, width = still.shape
    fewest = policy.fewest_edges * max(1.0, policy.enough / len(gradients)) ** 3
    for (down, along), part in _parts(spread(cv2.MORPH_CLOSE, still, policy.gap)):
        rows, columns = np.nonzero(part & still[down, along])
        if len(rows) < fewest:
            continue
        rows, columns = rows + down.start, columns + along.start
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


def _enclosed(around: Bool[np.ndarray, "height width"], steady: Bool[np.ndarray, "height width"]) -> np.ndarray:
    """Areas of steady colour between the edges of an overlay, such as bars and logos."""
    found = np.zeros_like(around)
    for place, part in _parts(steady & ~around, connectivity=4):
        border = spread(cv2.MORPH_DILATE, part, 3) & ~part
        if border.any() and around[place][border].mean() >= OVERLAY_POLICY.enclosed:
            found[place] |= part
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
