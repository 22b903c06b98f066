"""Bundle adjustment with priors on the lenses, by Levenberg–Marquardt and the Schur complement.

The objective, in pixels squared, is Σ c²·log(1 + |r|²/c²) over the observations, plus Σ w·((θ − μ)/σ)² over the lens
parameters: a maximum a posteriori estimate under heavy-tailed noise and normal priors.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch

LENS_PARAMETERS = 5
"""Logarithm of the focal length in pixels, principal point x and y in pixels, k1, k2."""
POINTS_AT_ONCE = 4096
PLACING_STEPS = 8


@dataclass(frozen=True)
class Observations:
    """Pixels [n, 2], centres at +0.5, in which the camera `camera` [n] sees the point `point` [n]."""

    pixels: np.ndarray
    camera: np.ndarray
    point: np.ndarray


@dataclass(frozen=True)
class Bundle:
    """World-to-camera poses [c, 3, 4], the lens of each camera [c], lens parameters [l, 5] and points [p, 3]."""

    poses: np.ndarray
    lens_of: np.ndarray
    lenses: np.ndarray
    points: np.ndarray


@dataclass(frozen=True)
class LensPrior:
    """Mean and standard deviation [l, 5] of the lens parameters, and what a deviation by one σ costs, in pixels²."""

    mean: np.ndarray
    sigma: np.ndarray
    weight: float

    def cost(self, lenses: np.ndarray) -> float:
        """What lenses [l, 5] cost, in pixels²."""
        return float(self.weight * (((lenses - self.mean) / self.sigma) ** 2).sum())


@dataclass(frozen=True)
class Loss:
    """Pixels `scale` beyond which an observation has less and less weight, and the weight of all observations."""

    scale: float
    weight: float = 1.0

    def total(self, squares: np.ndarray) -> float:
        """What observations cost whose residuals have these squares, in pixels²."""
        return float(self.weight * (self.scale**2 * np.log1p(squares / self.scale**2).sum()))


@dataclass(frozen=True)
class _Linear:
    """Residuals [n, 2] and their derivatives by pose [n, 2, 6], lens [n, 2, 5] and point [n, 2, 3]."""

    residuals: np.ndarray
    pose: np.ndarray
    lens: np.ndarray
    point: np.ndarray


def adjust(
    bundle: Bundle, seen: Observations, prior: LensPrior, loss: Loss, *, most_steps: int = 50, tolerance: float = 1e-5
) -> Bundle:
    """The bundle at a minimum of the objective; the search ends when a step lowers it by less than `tolerance` of it.

    The frame and the scale of the poses are free, so they stay about where they are.
    """
    current = objective(bundle, seen, prior, loss)
    damping, growth = 1e-4, 2.0
    for _ in range(most_steps):
        system = _System.of(bundle, seen, prior, loss)
        while damping < 1e12:
            moved = system.step(bundle, damping)
            value = objective(moved, seen, prior, loss) if moved else np.inf
            if moved and value < current:
                break
            damping, growth = damping * growth, growth * 2
        else:
            return bundle
        gain = current - value
        bundle, current, damping, growth = moved, value, max(damping / 5, 1e-10), 2.0
        if gain < tolerance * current:
            break
    return bundle


def place_points(bundle: Bundle, seen: Observations, loss: Loss) -> Bundle:
    """The bundle with each point at the place that its observations favour; cameras and lenses stay as they are."""
    for _ in range(PLACING_STEPS):
        linear = linearised(bundle, seen)
        squares = (linear.residuals**2).sum(1)
        weighted = linear.point / (1 + squares / loss.scale**2)[:, None, None]
        turned = weighted.transpose(0, 2, 1)
        own = _summed(turned @ linear.point, seen.point, len(bundle.points))
        slope = _summed((turned @ linear.residuals[:, :, None])[:, :, 0], seen.point, len(bundle.points))
        own += 1e-3 * own * np.eye(3) + 1e-12 * np.eye(3)
        points = bundle.points - np.linalg.solve(own, slope[:, :, None])[:, :, 0]
        moved = replace(bundle, points=points)
        # A point stays where a step would make its worst camera lose it or raise its error.
        before, after = (_costs(each, seen, loss) for each in (bundle, moved))
        better = (after < before)[:, None]
        bundle = replace(bundle, points=np.where(better, points, bundle.points))
    return bundle


def _costs(bundle: Bundle, seen: Observations, loss: Loss) -> np.ndarray:
    """The loss of each point [p], in pixels squared; infinite behind a camera."""
    pixels, depth = project(bundle, seen)
    squares = ((pixels - seen.pixels) ** 2).sum(1)
    costs = np.where(depth > 0, loss.scale**2 * np.log1p(squares / loss.scale**2), np.inf)
    return np.bincount(seen.point, costs, len(bundle.points))


def objective(bundle: Bundle, seen: Observations, prior: LensPrior, loss: Loss) -> float:
    """The value that `adjust` lowers, in pixels²; infinite where an observed point is behind its camera."""
    residuals, depth = project(bundle, seen)
    if (depth <= 0).any():
        return np.inf
    return loss.total(((residuals - seen.pixels) ** 2).sum(1)) + prior.cost(bundle.lenses)


def project(bundle: Bundle, seen: Observations) -> tuple[np.ndarray, np.ndarray]:
    """Pixels [n, 2] in which the cameras see their points, and the points' depths [n]."""
    poses, lenses = bundle.poses[seen.camera], bundle.lenses[bundle.lens_of[seen.camera]]
    local = np.einsum("nij,nj->ni", poses[:, :, :3], bundle.points[seen.point]) + poses[:, :, 3]
    depth = np.where(np.abs(local[:, 2]) > 1e-12, local[:, 2], 1e-12)
    flat = local[:, :2] / depth[:, None]
    square = (flat**2).sum(1)
    stretch = np.exp(lenses[:, 0]) * (1 + lenses[:, 3] * square + lenses[:, 4] * square**2)
    return flat * stretch[:, None] + lenses[:, 1:3], local[:, 2]


def linearised(bundle: Bundle, seen: Observations) -> _Linear:
    """Residuals in pixels, and their exact derivatives. A pose moves as exp(ω)·x + τ, in camera coordinates."""
    poses, lenses = bundle.poses[seen.camera], bundle.lenses[bundle.lens_of[seen.camera]]
    local = np.einsum("nij,nj->ni", poses[:, :, :3], bundle.points[seen.point]) + poses[:, :, 3]
    x, y, z = local.T
    u, v = x / z, y / z
    focal, k1, k2 = np.exp(lenses[:, 0]), lenses[:, 3], lenses[:, 4]
    square = u * u + v * v
    distortion = 1 + k1 * square + k2 * square**2
    flat = np.stack([u, v], 1)
    # d(distortion·u)/du = distortion + u·slope·u, and so on.
    slope = 2 * (k1 + 2 * k2 * square)
    by_flat = focal[:, None, None] * (
        distortion[:, None, None] * np.eye(2) + slope[:, None, None] * flat[:, :, None] * flat[:, None, :]
    )
    by_local = np.empty((len(z), 2, 3))
    by_local[:, :, :2] = by_flat / z[:, None, None]
    by_local[:, :, 2] = -(by_flat @ flat[:, :, None])[:, :, 0] / z[:, None]
    lens = np.zeros((len(z), 2, LENS_PARAMETERS))
    lens[:, :, 0] = (focal * distortion)[:, None] * flat
    lens[:, 0, 1] = lens[:, 1, 2] = 1
    lens[:, :, 3] = (focal * square)[:, None] * flat
    lens[:, :, 4] = (focal * square**2)[:, None] * flat
    pose = np.concatenate([np.cross(local[:, None, :], by_local), by_local], axis=2)
    residuals = lens[:, :, 0] + lenses[:, 1:3] - seen.pixels
    return _Linear(residuals, pose, lens, by_local @ poses[:, :, :3])


@dataclass(frozen=True)
class _System:
    """The normal equations: cameras and lenses [m, m], points [p, 3, 3], what couples them, and both gradients."""

    reduced: np.ndarray
    gradient: np.ndarray
    own: np.ndarray
    point_gradient: np.ndarray
    coupling: np.ndarray
    columns: np.ndarray
    point: np.ndarray

    @staticmethod
    def of(bundle: Bundle, seen: Observations, prior: LensPrior, loss: Loss) -> "_System":
        linear = linearised(bundle, seen)
        squares = (linear.residuals**2).sum(1)
        # The loss's slope weighs each observation (iteratively reweighted least squares).
        weight = loss.weight / (1 + squares / loss.scale**2)
        cameras, points = len(bundle.poses), len(bundle.points)
        size = 6 * cameras + bundle.lenses.size
        first_lens = 6 * cameras + LENS_PARAMETERS * bundle.lens_of[seen.camera]
        columns = np.concatenate(
            [6 * seen.camera[:, None] + np.arange(6), first_lens[:, None] + np.arange(LENS_PARAMETERS)], axis=1
        )
        both = np.concatenate([linear.pose, linear.lens], axis=2)
        reduced, gradient = np.zeros((size, size)), np.zeros(size)
        root = np.sqrt(weight)[:, None, None]
        everything = np.concatenate([both, linear.residuals[:, :, None]], axis=2) * root
        for camera in range(cameras):
            rows = np.flatnonzero(seen.camera == camera)
            if len(rows):
                own_columns = columns[rows[0]]
                products = _gram(everything[rows].reshape(-1, everything.shape[2]))
                reduced[np.ix_(own_columns, own_columns)] += products[:-1, :-1]
                gradient[own_columns] += products[:-1, -1]
        stiffness = prior.weight / prior.sigma**2
        lenses = np.arange(6 * cameras, size)
        reduced[lenses, lenses] += stiffness.ravel()
        gradient[lenses] += (stiffness * (bundle.lenses - prior.mean)).ravel()
        turned = (linear.point * weight[:, None, None]).transpose(0, 2, 1)
        own = _summed(turned @ linear.point, seen.point, points)
        point_gradient = _summed((turned @ linear.residuals[:, :, None])[:, :, 0], seen.point, points)
        return _System(reduced, gradient, own, point_gradient, turned @ both, columns, seen.point)

    def step(self, bundle: Bundle, damping: float) -> Bundle | None:
        """The bundle moved by a damped step, or None where the equations are singular at this damping.

        Damping is relative to the diagonal (Marquardt 1963).
        """
        try:
            return self._step(bundle, damping)
        except (np.linalg.LinAlgError, torch.linalg.LinAlgError):
            return None

    def _step(self, bundle: Bundle, damping: float) -> Bundle:
        reduced, right = self.reduced.copy(), -self.gradient
        diagonal = np.einsum("ii->i", reduced)
        diagonal += damping * np.maximum(diagonal, 1e-9)
        own = self.own + damping * np.maximum(self.own * np.eye(3), 1e-12 * np.eye(3))
        inverse = np.linalg.inv(own)
        root = np.linalg.cholesky(inverse)
        chunks = [(low, min(low + POINTS_AT_ONCE, len(own))) for low in range(0, len(own), POINTS_AT_ONCE)]
        for low, high in chunks:
            coupled = self._dense(low, high)
            whitened = root[low:high].transpose(0, 2, 1) @ coupled
            flat = whitened.reshape(-1, reduced.shape[0])
            reduced -= _gram(flat)
            whitened_gradient = root[low:high].transpose(0, 2, 1) @ self.point_gradient[low:high, :, None]
            right += flat.T @ whitened_gradient.ravel()
        moved = torch.linalg.solve(torch.from_numpy(reduced), torch.from_numpy(right)).numpy()
        coupled_step = (self.coupling @ moved[self.columns][:, :, None])[:, :, 0]
        back = self.point_gradient + _summed(coupled_step, self.point, len(own))
        points = bundle.points - (inverse @ back[:, :, None])[:, :, 0]
        cameras = 6 * len(bundle.poses)
        lenses = bundle.lenses + moved[cameras:].reshape(bundle.lenses.shape)
        return replace(bundle, poses=_moved(bundle.poses, moved[:cameras].reshape(-1, 6)), lenses=lenses, points=points)

    def _dense(self, low: int, high: int) -> np.ndarray:
        """What couples the points `low` to `high` with cameras and lenses [points, 3, m]."""
        size = len(self.gradient)
        rows = np.flatnonzero((self.point >= low) & (self.point < high))
        first = ((self.point[rows] - low) * 3)[:, None] + np.arange(3)
        places = first[:, :, None] * size + self.columns[rows][:, None, :]
        count = 3 * (high - low)
        return np.bincount(places.ravel(), self.coupling[rows].ravel(), count * size).reshape(high - low, 3, size)


def _gram(rows: np.ndarray) -> np.ndarray:
    """Rows' · rows. Beside other programs NumPy's threads wait for each other and take a hundred times as long."""
    some = torch.from_numpy(rows)
    return np.asarray((some.T @ some).numpy())


def _summed(values: np.ndarray, index: np.ndarray, count: int) -> np.ndarray:
    """Sums [count, …] of the values [n, …] with equal index [n]."""
    flat = values.reshape(len(values), -1)
    places = index[:, None] * flat.shape[1] + np.arange(flat.shape[1])
    return np.bincount(places.ravel(), flat.ravel(), count * flat.shape[1]).reshape(count, *values.shape[1:])


def _moved(poses: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Poses [c, 3, 4] turned by exp(ω) and shifted by τ; steps [c, 6] hold ω and τ."""
    angle = np.linalg.norm(steps[:, :3], axis=1)
    axis = steps[:, :3] / np.maximum(angle, 1e-300)[:, None]
    skew = np.zeros((len(steps), 3, 3))
    skew[:, 0, 1], skew[:, 0, 2], skew[:, 1, 2] = -axis[:, 2], axis[:, 1], -axis[:, 0]
    skew -= skew.transpose(0, 2, 1)
    turn = np.eye(3) + np.sin(angle)[:, None, None] * skew + (1 - np.cos(angle))[:, None, None] * skew @ skew
    moved = turn @ poses
    moved[:, :, 3] += steps[:, 3:]
    return moved
