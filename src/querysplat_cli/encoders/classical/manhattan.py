"""What straight lines in a photo say of its focal length: edges of rooms and buildings run in three directions.

These directions are at right angles (a Manhattan frame; Coughlan & Yuille 1999). Lines of one direction meet in a
vanishing point, and only the right focal length puts the three points at right angles. So for each focal length the
frame is looked for that explains the lines best. Where lines run anyhow, no focal length explains them better.

Pixels are in longer sides of the picture, from its middle. Cameras look along +z, x to the right, y down.
"""

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from querysplat_cli.encoders.classical.lines_policy import LINES_POLICY
from querysplat_cli.encoders.classical.policy import CAMERA_POLICY
from querysplat_cli.scene.decoding import reduced
from querysplat_cli.scene.masks import resized_mask


@dataclass(frozen=True)
class Lines:
    """Straight lines of a picture: their ends [n, 2, 2], weights [n], and the spreads [n] of their directions."""

    ends: np.ndarray
    weights: np.ndarray
    spreads: np.ndarray

    @staticmethod
    def between(ends: np.ndarray) -> "Lines":
        """The longest of the lines with these ends [n, 2, 2]."""
        policy = LINES_POLICY
        lengths = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
        kept = np.argsort(-lengths, kind="stable")[: policy.most]
        kept = kept[lengths[kept] > policy.shortest]
        lengths = lengths[kept]
        return Lines(
            ends[kept], np.minimum(lengths, policy.longest), np.hypot(policy.angle_spread, policy.end_spread / lengths)
        )


@dataclass(frozen=True)
class _Frame:
    """Three directions [3, 3], rows at right angles, and a distortion in longer sides, which is k1 over focal²."""

    directions: np.ndarray
    bend: float


@dataclass(frozen=True)
class _Straightened:
    """Middles and directions [n, 2] of the lines without distortion."""

    middles: np.ndarray
    along: np.ndarray

    @staticmethod
    def of(lines: Lines, bend: float) -> "_Straightened":
        ends = lines.ends / (1 + bend * (lines.ends**2).sum(-1, keepdims=True))
        steps = ends[:, 1] - ends[:, 0]
        return _Straightened(ends.mean(1), steps / np.linalg.norm(steps, axis=1, keepdims=True))

    def sines(self, directions: np.ndarray, focal: float) -> tuple[np.ndarray, np.ndarray]:
        """Sines of the angles at the lines' middles between them and the vanishing points of `directions` [..., 3].

        Also the distances to those points by which they were divided, in units of their depth. Both are [..., n].
        """
        point = focal * directions[..., None, :2] - self.middles * directions[..., None, 2:]
        distances = np.maximum(np.linalg.norm(point, axis=-1), 1e-12)
        across = point[..., 0] * self.along[:, 1] - point[..., 1] * self.along[:, 0]
        return across / distances, distances

    def planes(self, focal: float) -> np.ndarray:
        """Normals [n, 3] of the planes through the camera and the lines, of the length of their middles' rays."""
        x, y = self.middles.T
        along_x, along_y = self.along.T
        return np.column_stack([focal * along_y, -focal * along_x, y * along_x - x * along_y])


def straight_lines(grey: np.ndarray, mask: np.ndarray | None = None) -> Lines:
    """The straight lines of a grey picture [h, w], 8-bit, by LSD (Grompone von Gioi et al. 2012).

    Lines whose middle a mask [h, w] leaves out do not count.
    """
    picture = reduced(grey, LINES_POLICY.size)
    found = cv2.createLineSegmentDetector().detect(picture)[0]
    ends = np.zeros((0, 2, 2)) if found is None else found.reshape(-1, 2, 2).astype(np.float64)
    height, width = picture.shape
    if mask is not None:
        column, row = ends.mean(1).astype(np.int64).T
        ends = ends[resized_mask(mask, height, width)[row.clip(0, height - 1), column.clip(0, width - 1)]]
    return Lines.between((ends - [width / 2, height / 2]) / max(height, width))


def focal_evidence(lines: Lines, focals: np.ndarray, *, seed: int) -> np.ndarray:
    """Logarithms [f] of how much better a Manhattan frame explains the lines than directions by chance.

    One for each of the `focals` [f], ascending, in longer sides. Distortion has the prior of the lens.
    """
    if len(lines.ends) < LINES_POLICY.fewest:
        return np.zeros(len(focals))
    generator = np.random.default_rng(seed)
    straight = _Straightened.of(lines, 0.0)
    drawn = [_drawn_frames(lines, straight, focal, generator) for focal in focals]
    best = []
    for place, focal in enumerate(focals):
        near = [frame for some in drawn[max(place - 1, 0) : place + 2] for frame in some]
        best.append(max((_adjusted(frame, lines, focal) for frame in near), key=lambda pair: pair[1]))
    for places in (range(len(focals)), range(len(focals) - 1, -1, -1)):
        for before, place in pairwise(places):
            other = _adjusted(best[before][0], lines, focals[place])
            best[place] = max(best[place], other, key=lambda pair: pair[1])
    return np.array([value for _, value in best])


def _drawn_frames(lines: Lines, straight: _Straightened, focal: float, generator: np.random.Generator) -> list[_Frame]:
    """The frames that explain most lines, of those that three lines at a time determine. `straight` is undistorted."""
    policy = LINES_POLICY
    planes = straight.planes(focal)
    chances = lines.weights / lines.weights.sum()
    one, two, three = planes[generator.choice(len(planes), (policy.triples, 3), p=chances)].transpose(1, 0, 2)
    first = np.cross(one, two)
    second = np.cross(first, three)
    sizes = np.linalg.norm(first, axis=1), np.linalg.norm(second, axis=1)
    apart = (sizes[0] > 1e-4) & (sizes[1] > 1e-2 * sizes[0])
    first, second = (some[apart] / size[apart, None] for some, size in zip((first, second), sizes, strict=True))
    frames = np.stack([first, second, np.cross(first, second)], axis=1)
    values = _explained(lines, straight.sines(frames, focal)[0])
    return [_Frame(frames[row], 0.0) for row in np.argsort(-values, kind="stable")[: policy.candidates]]


def _explained(lines: Lines, sines: np.ndarray) -> np.ndarray:
    """The sum over all lines of the log-likelihood of the nearest direction's `sines` [..., 3, n], against chance."""
    return np.asarray(
        (np.log(_likelihood(lines, np.abs(sines).min(-2), 1.0) + LINES_POLICY.stray) * lines.weights).sum(-1)
    )


def _likelihood(lines: Lines, sines: np.ndarray, wider: float) -> np.ndarray:
    """That of lines [..., n] of one of three directions, by that of a direction by chance."""
    spreads = wider * lines.spreads
    density = np.exp(-0.5 * (sines / spreads) ** 2) / (spreads * np.sqrt(2 * np.pi))
    return np.asarray((1 - LINES_POLICY.stray) / 3 * np.pi * density)


def _adjusted(frame: _Frame, lines: Lines, focal: float) -> tuple[_Frame, float]:
    """The frame after some Gauss–Newton steps on the lines that it explains, and how well it explains them then."""
    policy = LINES_POLICY
    directions, bend = frame.directions, frame.bend
    spread = CAMERA_POLICY.distortion_spread[0] / focal**2
    rows = np.arange(len(lines.ends))
    for wider in policy.annealing:
        straight = _Straightened.of(lines, bend)
        sines, distances = straight.sines(directions, focal)
        nearest = np.abs(sines).argmin(0)
        errors = sines[nearest, rows]
        likelihood = _likelihood(lines, errors, wider)
        weights = lines.weights * likelihood / (likelihood + policy.stray) / (wider * lines.spreads) ** 2
        turns = np.cross(directions[nearest], straight.planes(focal)) / distances[nearest, rows, None]
        step = 0.01 * spread
        bent = _Straightened.of(lines, bend + step).sines(directions, focal)[0][nearest, rows]
        slopes = np.column_stack([turns, (bent - errors) / 0.01])
        normal = (slopes * weights[:, None]).T @ slopes + np.diag([1e-6, 1e-6, 1e-6, 1.0])
        change = -np.linalg.solve(normal, (slopes * weights[:, None]).T @ errors + [0, 0, 0, bend / spread])
        turn = change[:3] * min(1.0, policy.largest_turn / max(float(np.linalg.norm(change[:3])), 1e-12))
        directions = directions @ cv2.Rodrigues(turn)[0].T
        bend = float(np.clip(bend + np.clip(change[3], -1, 1) * spread, *(np.array([-1, 1]) * policy.bend / focal**2)))
    value = _explained(lines, _Straightened.of(lines, bend).sines(directions, focal)[0])
    return _Frame(directions, bend), float(value) - 0.5 * (bend / spread) ** 2
