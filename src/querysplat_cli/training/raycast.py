"""Rays against boxes, balls and cylinders, compiled: what a ray meets, and the depth of a pinhole camera.

A solid is a unit shape (the cube [-1, 1]³, the ball of radius 1, the cylinder of radius 1 between z = -1 and
1), stretched to its size, turned about the vertical z axis, and moved. Rays are carried into that unit frame,
where each intersection is one closed formula.
"""

import math

import numba as nb
import numpy as np

from querysplat_cli.training.intersections import hit_ball, hit_box, hit_cylinder

BOX, BALL, CYLINDER = 0, 1, 2
KIND, PAINT, GRAIN, SEED, COS, SIN, BOUND = range(7)
CENTRE, SIZE, FIRST, SECOND = (slice(start, start + 3) for start in range(7, 19, 3))
GLOSS = 19
TABLE_COLUMNS = 20
"""A solid is a row of these columns. BOUND is the squared radius of the ball around it."""
CX, SX = CENTRE.start, SIZE.start
RUN = 16
"""Neighbours in a row of pixels that share their candidates."""
SLACK = 1 + 1e-9
"""Balls that only touch count as candidates: their distances are rounded."""


@nb.njit(cache=True, error_model="numpy")
def to_unit(solids, i, x, y, z):  # type: ignore[no-untyped-def]
    c, s = solids[i, COS], solids[i, SIN]
    return (c * x + s * y) / solids[i, SX], (c * y - s * x) / solids[i, SX + 1], z / solids[i, SX + 2]


@nb.njit(cache=True, error_model="numpy")
def distance(solids, i, origin, direction, square):  # type: ignore[no-untyped-def]
    """Where the ray meets solid i, in units of `direction`, whose squared length is `square`."""
    x, y, z = origin[0] - solids[i, CX], origin[1] - solids[i, CX + 1], origin[2] - solids[i, CX + 2]
    along = x * direction[0] + y * direction[1] + z * direction[2]
    if (x * x + y * y + z * z - solids[i, BOUND]) * square > along * along:
        return np.inf
    o = to_unit(solids, i, x, y, z)
    d = to_unit(solids, i, direction[0], direction[1], direction[2])
    if solids[i, KIND] == BOX:
        return hit_box(o, d)
    if solids[i, KIND] == BALL:
        return hit_ball(o, d)
    return hit_cylinder(o, d)


@nb.njit(cache=True, error_model="numpy")
def nearest(solids, candidates, origin, direction):  # type: ignore[no-untyped-def]
    best, which = np.inf, -1
    square = direction[0] ** 2 + direction[1] ** 2 + direction[2] ** 2
    for i in candidates:
        t = distance(solids, i, origin, direction, square)
        if t < best:
            best, which = t, i
    return best, which


@nb.njit(cache=True, error_model="numpy")
def touching(solids, candidates, start, along, longest, widths):  # type: ignore[no-untyped-def]
    """The candidates that a ray within a cone from `start` to `start` + `longest` × `along` may meet, in their order.

    These are the ones whose balls reach into it. `widths` are the cone's radius at its start, and by how much that
    grows with the distance from there.
    """
    reach, growth = widths
    square = along[0] ** 2 + along[1] ** 2 + along[2] ** 2
    found, count = np.empty(len(candidates), np.int64), 0
    for i in candidates:
        x, y, z = solids[i, CX] - start[0], solids[i, CX + 1] - start[1], solids[i, CX + 2] - start[2]
        t = min(longest, max(0.0, (x * along[0] + y * along[1] + z * along[2]) / square))
        apart = (x - t * along[0]) ** 2 + (y - t * along[1]) ** 2 + (z - t * along[2]) ** 2
        ball = math.sqrt(solids[i, BOUND])
        radius = ball + reach + growth * (math.sqrt(x * x + y * y + z * z) + ball)
        if apart <= SLACK * radius * radius:
            found[count] = i
            count += 1
    return found[:count]


@nb.njit(cache=True, error_model="numpy")
def _unit_normal(shape, p):  # type: ignore[no-untyped-def]
    """Outward normal of the unit shape at `p`, a place on its surface."""
    if shape == BALL:
        return p
    if shape == CYLINDER:
        if abs(p[2]) > p[0] * p[0] + p[1] * p[1]:
            return 0.0, 0.0, math.copysign(1.0, p[2])
        return p[0], p[1], 0.0
    x, y, z = abs(p[0]), abs(p[1]), abs(p[2])
    if x >= y and x >= z:
        return math.copysign(1.0, p[0]), 0.0, 0.0
    if y >= z:
        return 0.0, math.copysign(1.0, p[1]), 0.0
    return 0.0, 0.0, math.copysign(1.0, p[2])


@nb.njit(cache=True, error_model="numpy")
def outward(solids, i, place):  # type: ignore[no-untyped-def]
    """The place on solid i in its own frame (metres), the unit shape's normal there, and the world's."""
    p = to_unit(solids, i, place[0] - solids[i, CX], place[1] - solids[i, CX + 1], place[2] - solids[i, CX + 2])
    n = _unit_normal(solids[i, KIND], p)
    c, s = solids[i, COS], solids[i, SIN]
    # Normals stretch by the inverse of the size.
    x, y, z = n[0] / solids[i, SX], n[1] / solids[i, SX + 1], n[2] / solids[i, SX + 2]
    length = math.sqrt(x * x + y * y + z * z)
    point = (p[0] * solids[i, SX], p[1] * solids[i, SX + 1], p[2] * solids[i, SX + 2])
    return point, n, ((c * x - s * y) / length, (s * x + c * y) / length, z / length)


@nb.njit(cache=True, error_model="numpy")
def ray(camera, column, row):  # type: ignore[no-untyped-def]
    """Direction with camera z 1, so that distance along it is depth."""
    c2w, lens = camera
    x, y = (column - lens[2]) / lens[0], (row - lens[3]) / lens[1]
    return (
        c2w[0, 0] * x + c2w[0, 1] * y + c2w[0, 2],
        c2w[1, 0] * x + c2w[1, 1] * y + c2w[1, 2],
        c2w[2, 0] * x + c2w[2, 1] * y + c2w[2, 2],
    )


@nb.njit(cache=True, error_model="numpy")
def eye_of(camera):  # type: ignore[no-untyped-def]
    c2w = camera[0]
    return c2w[0, 3], c2w[1, 3], c2w[2, 3]


@nb.njit(cache=True, error_model="numpy")
def in_run(solids, everything, camera, first, row):  # type: ignore[no-untyped-def]
    """Which of `everything`, the numbers of all solids, RUN pixels of a row from column `first` on may show."""
    middle = ray(camera, first + RUN / 2, row + 0.5)
    spread = (RUN / 2 + 1) / min(camera[1][0], camera[1][1])
    return touching(solids, everything, eye_of(camera), middle, np.inf, (0.0, spread))


@nb.njit(cache=True, error_model="numpy", parallel=True)
def measure_view(solids, camera, depth, face):  # type: ignore[no-untyped-def]
    """Fill `depth` [height, width] (camera z through each pixel's middle; 0: nothing hit) and `face` (a number
    for each face of each solid; -1: nothing). `camera` is c2w, and (fx, fy, cx, cy) in pixels."""
    height, width = depth.shape
    origin, everything = eye_of(camera), np.arange(len(solids))
    for row in nb.prange(height):
        for first in range(0, width, RUN):
            candidates = in_run(solids, everything, camera, first, row)
            for column in range(first, min(width, first + RUN)):
                d = ray(camera, column + 0.5, row + 0.5)
                t, i = nearest(solids, candidates, origin, d)
                depth[row, column], face[row, column] = 0.0, -1
                if i >= 0:
                    _, n, _ = outward(solids, i, (origin[0] + t * d[0], origin[1] + t * d[1], origin[2] + t * d[2]))
                    flat = 0 if solids[i, KIND] == BALL else (1 if abs(n[0]) == 1 else (2 if abs(n[2]) == 1 else 3))
                    depth[row, column], face[row, column] = t, 4 * i + flat
