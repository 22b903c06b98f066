"""PatchMatch refinement (Bleyer et al. 2011; red and black pixels as in Galliani et al. 2015).

Every pixel has a plane, stored as its inverse depth and the slopes of the inverse depth along x and y: in a picture,
the inverse depth of a plane is exactly linear. A pixel takes a neighbour's plane, or a small change of its own, where
that explains the sources better. So slanted surfaces match well, and depths between the planes of the sweep are found.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numba as nb
import numpy as np

from querysplat_cli.encoders.classical.depth_policy import DEPTH_POLICY
from querysplat_cli.encoders.classical.neighbours import InverseRange
from querysplat_cli.splat.compiled_memory import scratch

# Plain numbers, since a compiled kernel cannot read a dataclass.
_REFINEMENT_REACH = DEPTH_POLICY.refinement_reach
_SIMILAR_BRIGHTNESS = DEPTH_POLICY.similar_brightness
_PRIOR_COST = DEPTH_POLICY.prior_cost
_CONTRADICTION_COST = DEPTH_POLICY.contradiction_cost
_FULL_COST_DIFFERENCE = DEPTH_POLICY.full_cost_difference
_UNSEEN_COST = DEPTH_POLICY.unseen_cost
_CORRELATION_FLOOR = DEPTH_POLICY.correlation_floor
_STEPS = np.arange(-_REFINEMENT_REACH, _REFINEMENT_REACH + 1, 2).astype(np.float32)
_WINDOW = len(_STEPS) ** 2
"""Samples of a window."""
_SAMPLES = 32
"""The same, with some of weight 0 that fill the last vector."""
_DX, _DY = np.zeros(_SAMPLES, np.float32), np.zeros(_SAMPLES, np.float32)
"""Where the samples of a window lie, from its middle."""
_DX[:_WINDOW], _DY[:_WINDOW] = np.tile(_STEPS, len(_STEPS)), np.repeat(_STEPS, len(_STEPS))


@dataclass(frozen=True)
class Planes:
    """A plane for each pixel [height, width]: its `inverse` depth, and how that changes per pixel along x and y."""

    inverse: np.ndarray
    slope_x: np.ndarray
    slope_y: np.ndarray


@dataclass(frozen=True)
class Source:
    """A view that another one is compared with.

    `grey` [height, width] is in [0, 1], negative where there is no picture. `K` [3, 3] has pixel centres at +0.5,
    `w2c` is [4, 4]. `inverse` [height, width] is the view's inverse depth, 0 where it is unknown.
    """

    grey: np.ndarray
    K: np.ndarray
    w2c: np.ndarray
    inverse: np.ndarray

    def seen_from(self, other: "Source") -> np.ndarray:
        """The transform [4, 4] from the camera of `other` to this one."""
        return np.asarray(self.w2c @ np.linalg.inv(other.w2c))

    def baseline(self, other: "Source") -> float:
        """The distance of both cameras times this one's focal length: pixels of disparity per inverse depth."""
        return float(np.linalg.norm(self.seen_from(other)[:3, 3]) * self.K[0, 0])


def projections(view: Source, others: Sequence[Source]) -> tuple[np.ndarray, np.ndarray]:
    """A [n, 3, 3] and b [n, 3] of the other views: a pixel p of `view` with inverse depth q projects to A·p + q·b."""
    to_rays = np.linalg.inv(view.K)
    relative = [other.seen_from(view) for other in others]
    leads = np.stack([other.K @ T[:3, :3] @ to_rays for other, T in zip(others, relative, strict=True)])
    return leads, np.stack([other.K @ T[:3, 3] for other, T in zip(others, relative, strict=True)])


def refine_planes(
    view: Source, sources: list[Source], start: Planes, limits: InverseRange
) -> tuple[Planes, np.ndarray]:
    """Better planes, and their matching cost [height, width] from 0 (perfect) to 1 (no match).

    Leaving `start` costs something, which keeps even surfaces smooth. The changes that are tried follow a fixed
    pattern, so equal inputs give equal bits.
    """
    leads, shifts = projections(view, sources)
    views = (
        leads.astype(np.float32),
        shifts.astype(np.float32),
        np.stack([source.grey.ravel() for source in sources]),
        np.stack([source.inverse for source in sources]),
    )
    bounds = np.float32(limits.far), np.float32(limits.near)
    state = np.stack([start.inverse, start.slope_x, start.slope_y, np.full_like(start.inverse, 2)])
    for turn in range(2):
        for colour in range(2):
            _improve(state, colour, turn, view.grey, *views, start.inverse, *bounds)
    return Planes(*state[:3]), np.clip(state[3], 0, 1)


@nb.njit(cache=True, error_model="numpy", parallel=True, fastmath=True)
def _improve(state, colour, turn, grey, leads, shifts, pictures, known, prior, least, most):
    """Improve the pixels of one colour of the chessboard. Turn 0 only measures their cost."""
    height, width = grey.shape
    for y in nb.prange(height):
        samples, weights = nb.carray(scratch(_SAMPLES), _SAMPLES), nb.carray(scratch(_SAMPLES), _SAMPLES)
        places = np.empty(_SAMPLES, np.int32)
        for n in range(_SAMPLES):
            samples[n] = weights[n] = np.float32(0)
        for x in range((y + colour) % 2, width, 2):
            if grey[y, x] < 0:
                continue
            mean, spread = _window(grey, x, y, samples, weights)
            inverse, slope_x, slope_y = state[0, y, x], state[1, y, x], state[2, y, x]
            # Turn 0 has one trial, the plane as it is. The cost is called in one place: each call is compiled apart.
            best = state[3, y, x] if turn else np.float32(np.inf)
            for trial in range(0 if turn else -1, 6 if turn else 0):
                new, new_x, new_y = inverse, slope_x, slope_y
                if 0 <= trial < 4:
                    from_x, from_y = _best_towards(state, x, y, trial, width, height)
                    if from_x < 0:
                        continue
                    new_x, new_y = state[1, from_y, from_x], state[2, from_y, from_x]
                    new = state[0, from_y, from_x] + new_x * (x - from_x) + new_y * (y - from_y)
                elif trial >= 4:
                    size = np.float32(0.02 if trial == 4 else 0.004)
                    new = inverse * (1 + size * _noise(x, y, 8 * turn + trial, 0))
                    new_x = slope_x + size * inverse * np.float32(0.1) * _noise(x, y, 8 * turn + trial, 1)
                    new_y = slope_y + size * inverse * np.float32(0.1) * _noise(x, y, 8 * turn + trial, 2)
                if turn and not least <= new <= most:
                    continue
                apart = abs(new / prior[y, x] - np.float32(1))
                pull = np.float32(_PRIOR_COST) * min(apart / np.float32(_FULL_COST_DIFFERENCE), np.float32(1))
                cost = pull + _cost(
                    x, y, new, new_x, new_y, samples, weights, mean, spread, leads, shifts, pictures, known, places
                )  # fmt: skip
                if cost < best:
                    best, inverse, slope_x, slope_y = cost, new, new_x, new_y
            state[0, y, x], state[1, y, x], state[2, y, x], state[3, y, x] = inverse, slope_x, slope_y, best


@nb.njit(cache=True, error_model="numpy", inline="always")
def _best_towards(state, x, y, direction, width, height):
    """The pixel of lowest cost among those 1, 3 and 7 to one side; all have the other colour."""
    step_x = (1, -1, 0, 0)[direction]
    step_y = (0, 0, 1, -1)[direction]
    best_x, best_y, best = -1, -1, np.float32(1e9)
    for distance in (1, 3, 7):
        there_x, there_y = x + distance * step_x, y + distance * step_y
        if 0 <= there_x < width and 0 <= there_y < height and state[3, there_y, there_x] < best:
            best_x, best_y, best = there_x, there_y, state[3, there_y, there_x]
    return best_x, best_y


@nb.njit(cache=True, error_model="numpy", inline="always")
def _noise(x, y, turn, which):
    """A pseudo-random number in [-1, 1) that depends on the arguments alone."""
    bits = np.uint32(x * 73856093) ^ np.uint32(y * 19349663) ^ np.uint32((3 * turn + which + 1) * 83492791)
    bits = (bits ^ (bits >> np.uint32(13))) * np.uint32(0x5BD1E995)
    bits = (bits ^ (bits >> np.uint32(15))) * np.uint32(0x27D4EB2D)
    return np.float32((bits ^ (bits >> np.uint32(16))) & np.uint32(0xFFFF)) / np.float32(32768) - np.float32(1)


@nb.njit(cache=True, error_model="numpy", fastmath=True, forceinline=True)
def _window(grey, x, y, samples, weights):
    """Fill the reference samples and their weights, which sum to one; return the mean and the variance."""
    height, width = grey.shape
    total = mean = square = np.float32(0)
    n = 0
    for dy in range(-_REFINEMENT_REACH, _REFINEMENT_REACH + 1, 2):
        for dx in range(-_REFINEMENT_REACH, _REFINEMENT_REACH + 1, 2):
            value = grey[min(max(y + dy, 0), height - 1), min(max(x + dx, 0), width - 1)]
            weight = np.exp(-abs(value - grey[y, x]) / np.float32(_SIMILAR_BRIGHTNESS)) if value >= 0 else np.float32(0)
            samples[n], weights[n] = value, weight
            total += weight
            mean += weight * value
            square += weight * value * value
            n += 1
    mean /= total
    for i in range(n):
        weights[i] /= total
    return mean, max(square / total - mean * mean, np.float32(0)) + np.float32(_CORRELATION_FLOOR)


@nb.njit(cache=True, error_model="numpy", fastmath=True, forceinline=True)
def _cost(
    x, y, inverse, slope_x, slope_y, samples, weights, mean, spread, leads, shifts, pictures, known, places
):  # fmt: skip
    """The mean over the two best sources of one minus the correlation, plus the cost of contradiction.

    `pictures` are flat, [sources, height·width], and `places` has room for indices. Loops over `n` have constant length
    and no branches, and become a few vector instructions. No source's part of an array is taken out: numba would count
    references to it, which took a third of the time.
    """
    count, height, width = known.shape
    right, bottom = np.float32(width - 1.01), np.float32(height - 1.01)
    zero, half, one, nearest = np.float32(0), np.float32(0.5), np.float32(1), np.float32(1e-3)
    across, down = nb.carray(scratch(_SAMPLES), _SAMPLES), nb.carray(scratch(_SAMPLES), _SAMPLES)
    a, b = nb.carray(scratch(_SAMPLES), _SAMPLES), nb.carray(scratch(_SAMPLES), _SAMPLES)
    c, d = nb.carray(scratch(_SAMPLES), _SAMPLES), nb.carray(scratch(_SAMPLES), _SAMPLES)
    for n in range(_SAMPLES):
        a[n] = b[n] = c[n] = d[n] = zero
    px, py = np.float32(x + 0.5), np.float32(y + 0.5)
    best = second = np.float32(_UNSEEN_COST)
    for s in range(count):
        u = leads[s, 0, 0] * px + leads[s, 0, 1] * py + leads[s, 0, 2] + inverse * shifts[s, 0]
        v = leads[s, 1, 0] * px + leads[s, 1, 1] * py + leads[s, 1, 2] + inverse * shifts[s, 1]
        z = leads[s, 2, 0] * px + leads[s, 2, 1] * py + leads[s, 2, 2] + inverse * shifts[s, 2]
        if z <= nearest:
            continue
        column, row = int(np.floor(u / z)), int(np.floor(v / z))
        if not (0 <= column < width and 0 <= row < height) or pictures[s, row * width + column] < 0:
            continue
        u_x, u_y = leads[s, 0, 0] + slope_x * shifts[s, 0], leads[s, 0, 1] + slope_y * shifts[s, 0]
        v_x, v_y = leads[s, 1, 0] + slope_x * shifts[s, 1], leads[s, 1, 1] + slope_y * shifts[s, 1]
        z_x, z_y = leads[s, 2, 0] + slope_x * shifts[s, 2], leads[s, 2, 1] + slope_y * shifts[s, 2]
        for n in range(_SAMPLES):
            depth = one / max(z + _DX[n] * z_x + _DY[n] * z_y, nearest)
            at_x = min(max((u + _DX[n] * u_x + _DY[n] * u_y) * depth - half, zero), right)
            at_y = min(max((v + _DX[n] * v_x + _DY[n] * v_y) * depth - half, zero), bottom)
            i, j = np.int32(at_x), np.int32(at_y)
            across[n], down[n] = at_x - np.float32(i), at_y - np.float32(j)
            places[n] = j * np.int32(width) + i
        for n in range(_WINDOW):
            place = np.uint64(places[n])
            a[n], b[n] = pictures[s, place], pictures[s, place + np.uint64(1)]
            place += np.uint64(width)
            c[n], d[n] = pictures[s, place], pictures[s, place + np.uint64(1)]
        there = square = product = zero
        darkest = one
        for n in range(_SAMPLES):
            top, low = a[n] + across[n] * (b[n] - a[n]), c[n] + across[n] * (d[n] - c[n])
            value = top + down[n] * (low - top)
            weighted = weights[n] * value
            there += weighted
            square += weighted * value
            product += weighted * samples[n]
            darkest = min(darkest, min(min(a[n], b[n]), min(c[n], d[n])))
        here, around = mean, spread
        if darkest < 0:  # the window without the samples that the source has no picture of
            there = square = product = here = around = left = zero
            for n in range(_SAMPLES):
                top, low = a[n] + across[n] * (b[n] - a[n]), c[n] + across[n] * (d[n] - c[n])
                value = top + down[n] * (low - top)
                weight = weights[n] if min(min(a[n], b[n]), min(c[n], d[n])) >= 0 else zero
                left += weight
                there, here = there + weight * value, here + weight * samples[n]
                square, around = square + weight * value * value, around + weight * samples[n] * samples[n]
                product += weight * value * samples[n]
            left = max(left, nearest)
            there, square, product, here = there / left, square / left, product / left, here / left
            around = max(around / left - here * here, zero) + np.float32(_CORRELATION_FLOOR)
        variance = max(square - there * there, zero) + np.float32(_CORRELATION_FLOOR)
        cost = np.float32(1) - (product - there * here) / np.sqrt(variance * around)
        if known[s, row, column] > 0:
            # z is depth there over depth here, so this is the relative difference of the two depths.
            apart = abs(z / inverse * known[s, row, column] - np.float32(1))
            cost += np.float32(_CONTRADICTION_COST) * min(apart / np.float32(_FULL_COST_DIFFERENCE), np.float32(1))
        if count == 1:
            best = second = cost
        elif cost < best:
            best, second = cost, best
        elif cost < second:
            second = cost
    return (best + second) * half
