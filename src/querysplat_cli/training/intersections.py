"""Where a ray meets a unit shape, compiled.

The shapes are the cube [-1, 1]³, the ball of radius 1, and the cylinder of radius 1 between z = -1 and 1.
"""

import math

import numba as nb
import numpy as np

NEAR = 1e-4
"""Distance along a ray below which nothing is hit, in units of the ray's direction."""


@nb.njit(cache=True, error_model="numpy")
def _first_root(a, half_b, c, o, d, tall):  # type: ignore[no-untyped-def]
    """Smaller root beyond NEAR of a t² + 2 half_b t + c; for cylinders only where |z| ≤ 1."""
    inside = half_b * half_b - a * c
    if inside < 0 or a == 0:
        return np.inf
    # The form without cancellation: one root by the sum, the other by the product of both.
    q = -(half_b + math.copysign(math.sqrt(inside), half_b))
    first, second = q / a, (c / q if q != 0 else np.inf)
    for t in (min(first, second), max(first, second)):
        if t > NEAR and (not tall or abs(o[2] + t * d[2]) <= 1):
            return t
    return np.inf


@nb.njit(cache=True, error_model="numpy")
def hit_box(o, d):  # type: ignore[no-untyped-def]
    """Smallest distance beyond NEAR at which the ray meets the cube's surface; infinity if none."""
    enter, leave = -np.inf, np.inf
    for axis in range(3):
        inverse = 1.0 / d[axis] if d[axis] != 0 else 1e300
        a, b = (-1 - o[axis]) * inverse, (1 - o[axis]) * inverse
        enter, leave = max(enter, min(a, b)), min(leave, max(a, b))
    if enter > leave:
        return np.inf
    if enter > NEAR:
        return enter
    return leave if leave > NEAR else np.inf


@nb.njit(cache=True, error_model="numpy")
def hit_ball(o, d):  # type: ignore[no-untyped-def]
    a = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
    half_b = o[0] * d[0] + o[1] * d[1] + o[2] * d[2]
    return _first_root(a, half_b, o[0] * o[0] + o[1] * o[1] + o[2] * o[2] - 1, o, d, False)


@nb.njit(cache=True, error_model="numpy")
def hit_cylinder(o, d):  # type: ignore[no-untyped-def]
    a = d[0] * d[0] + d[1] * d[1]
    side = _first_root(a, o[0] * d[0] + o[1] * d[1], o[0] * o[0] + o[1] * o[1] - 1, o, d, True)
    if d[2] == 0:
        return side
    for lid in (-math.copysign(1.0, d[2]), math.copysign(1.0, d[2])):
        t = (lid - o[2]) / d[2]
        x, y = o[0] + t * d[0], o[1] + t * d[1]
        if t > NEAR and t < side and x * x + y * y <= 1:
            return t
    return side
