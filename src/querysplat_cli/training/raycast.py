"""Ray casting of boxes, balls and cylinders, compiled: the image and the depth of a pinhole camera.

A solid is a unit shape (the cube [-1, 1]³, the ball of radius 1, the cylinder of radius 1 between z = -1 and
1), stretched to its size, turned about the vertical z axis, and moved. Rays are carried into that unit frame,
where each intersection is one closed formula.
"""

import math

import numba as nb
import numpy as np

from querysplat_cli.training.intersections import hit_ball, hit_box, hit_cylinder
from querysplat_cli.training.textures import paint

BOX, BALL, CYLINDER = 0, 1, 2
KIND, PAINT, GRAIN, SEED, COS, SIN, BOUND = range(7)
CENTRE, SIZE, FIRST, SECOND = (slice(start, start + 3) for start in range(7, 19, 3))
GLOSS = 19
TABLE_COLUMNS = 20
"""A solid is a row of these columns. BOUND is the squared radius of the ball around it."""
CX, SX, RED1, RED2 = CENTRE.start, SIZE.start, FIRST.start, SECOND.start
BRIGHTNESS = 6.0
LIFT = 1e-4
"""How far above its surface a shadow ray starts, in metres."""


@nb.njit(cache=True, error_model="numpy")
def _to_unit(solids, i, x, y, z):  # type: ignore[no-untyped-def]
    c, s = solids[i, COS], solids[i, SIN]
    return (c * x + s * y) / solids[i, SX], (c * y - s * x) / solids[i, SX + 1], z / solids[i, SX + 2]


@nb.njit(cache=True, error_model="numpy")
def _distance(solids, i, origin, direction, square):  # type: ignore[no-untyped-def]
    """Where the ray meets solid i, in units of `direction`, whose squared length is `square`."""
    x, y, z = origin[0] - solids[i, CX], origin[1] - solids[i, CX + 1], origin[2] - solids[i, CX + 2]
    along = x * direction[0] + y * direction[1] + z * direction[2]
    if (x * x + y * y + z * z - solids[i, BOUND]) * square > along * along:
        return np.inf
    o = _to_unit(solids, i, x, y, z)
    d = _to_unit(solids, i, direction[0], direction[1], direction[2])
    if solids[i, KIND] == BOX:
        return hit_box(o, d)
    if solids[i, KIND] == BALL:
        return hit_ball(o, d)
    return hit_cylinder(o, d)


@nb.njit(cache=True, error_model="numpy")
def _nearest(solids, candidates, origin, direction):  # type: ignore[no-untyped-def]
    best, which = np.inf, -1
    square = direction[0] ** 2 + direction[1] ** 2 + direction[2] ** 2
    for i in candidates:
        t = _distance(solids, i, origin, direction, square)
        if t < best:
            best, which = t, i
    return best, which


@nb.njit(cache=True, error_model="numpy")
def _lamplight(solids, opaque, lamps, place, normal):  # type: ignore[no-untyped-def]
    """Mean light of the lamp's points; a hidden point gives none.

    Where all or none of the first half are hidden, the second half is taken to be so, too.
    """
    light, seen = 0.0, 0
    for number in range(len(lamps)):
        if number == len(lamps) // 2 and (seen == 0 or seen == number):
            return light / number
        to = (lamps[number, 0] - place[0], lamps[number, 1] - place[1], lamps[number, 2] - place[2])
        square = to[0] * to[0] + to[1] * to[1] + to[2] * to[2]
        cosine = (normal[0] * to[0] + normal[1] * to[1] + normal[2] * to[2]) / math.sqrt(square)
        lit = cosine > 0
        for i in opaque:
            if not lit:
                break
            lit = _distance(solids, i, place, to, square) >= 1.0
        if lit:
            light, seen = light + cosine / (1.0 + square), seen + 1
    return light / len(lamps)


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
def _face(shape, point, n, size):  # type: ignore[no-untyped-def]
    """u, v on the face from its middle and the face's extent, in metres."""
    x, y, z = point
    if shape == BALL or (shape == CYLINDER and n[2] == 0):
        return math.atan2(y / size[1], x / size[0]) * size[0], z, 2 * math.pi * size[0], 2 * size[2]
    if shape == CYLINDER or n[2] != 0:
        return x, y, 2 * size[0], 2 * size[1]
    if n[1] != 0:
        return x, z, 2 * size[0], 2 * size[2]
    return y, z, 2 * size[1], 2 * size[2]


@nb.njit(cache=True, error_model="numpy")
def _outward(solids, i, place):  # type: ignore[no-untyped-def]
    """The place on solid i in its own frame (metres), the unit shape's normal there, and the world's."""
    p = _to_unit(solids, i, place[0] - solids[i, CX], place[1] - solids[i, CX + 1], place[2] - solids[i, CX + 2])
    n = _unit_normal(solids[i, KIND], p)
    c, s = solids[i, COS], solids[i, SIN]
    # Normals stretch by the inverse of the size.
    x, y, z = n[0] / solids[i, SX], n[1] / solids[i, SX + 1], n[2] / solids[i, SX + 2]
    length = math.sqrt(x * x + y * y + z * z)
    point = (p[0] * solids[i, SX], p[1] * solids[i, SX + 1], p[2] * solids[i, SX + 2])
    return point, n, ((c * x - s * y) / length, (s * x + c * y) / length, z / length)


@nb.njit(cache=True, error_model="numpy")
def _shade(solids, opaque, lamps, i, origin, direction, t, spread):  # type: ignore[no-untyped-def]
    """Linear RGB that leaves solid i towards the eye: Lambert's law with soft shadows.

    `spread` is the width of what the ray stands for, at distance 1.
    """
    place = (origin[0] + t * direction[0], origin[1] + t * direction[1], origin[2] + t * direction[2])
    point, n, normal = _outward(solids, i, place)
    facing = normal[0] * direction[0] + normal[1] * direction[1] + normal[2] * direction[2]
    slant = abs(facing) / math.sqrt(direction[0] ** 2 + direction[1] ** 2 + direction[2] ** 2)
    size = (solids[i, SX], solids[i, SX + 1], solids[i, SX + 2])
    red, green, blue = paint(
        solids[i, PAINT],
        point,
        _face(solids[i, KIND], point, n, size),
        (
            (solids[i, RED1], solids[i, RED1 + 1], solids[i, RED1 + 2]),
            (solids[i, RED2], solids[i, RED2 + 1], solids[i, RED2 + 2]),
        ),
        solids[i, GRAIN],
        np.int64(solids[i, SEED]),
        t * spread / max(0.4, slant),
    )
    above = (place[0] + LIFT * normal[0], place[1] + LIFT * normal[1], place[2] + LIFT * normal[2])
    light = BRIGHTNESS * _lamplight(solids, opaque, lamps, above, normal)
    # Light from everywhere: more from above, less near the floor.
    ambient = 0.42 + 0.13 * normal[2] + 0.06 * normal[0] - 0.05 * normal[1]
    ambient *= 1.0 - 0.45 * math.exp(-max(0.0, place[2]) / 0.12) * (1.0 - max(0.0, normal[2]))
    return (
        red * (0.94 * ambient + light),
        green * (0.98 * ambient + 0.95 * light),
        blue * (1.08 * ambient + 0.84 * light),
    )


@nb.njit(cache=True, error_model="numpy")
def _mirrored(solids, light, everything, i, origin, direction, t, spread):  # type: ignore[no-untyped-def]
    """Linear RGB that a glossy solid i reflects towards the eye, and its share of what leaves it (Schlick).

    What it shows is lit but reflects nothing itself. Where the mirrored ray meets nothing, it is black.
    """
    opaque, lamps = light
    place = (origin[0] + t * direction[0], origin[1] + t * direction[1], origin[2] + t * direction[2])
    _, _, normal = _outward(solids, i, place)
    length = math.sqrt(direction[0] ** 2 + direction[1] ** 2 + direction[2] ** 2)
    along = direction[0] * normal[0] + direction[1] * normal[1] + direction[2] * normal[2]
    share = solids[i, GLOSS] + (1 - solids[i, GLOSS]) * (1 - min(1.0, abs(along) / length)) ** 5
    above = (place[0] + LIFT * normal[0], place[1] + LIFT * normal[1], place[2] + LIFT * normal[2])
    away = (
        direction[0] - 2 * along * normal[0],
        direction[1] - 2 * along * normal[1],
        direction[2] - 2 * along * normal[2],
    )
    beyond, other = _nearest(solids, everything, above, away)
    if other < 0:
        return (0.0, 0.0, 0.0), share
    return _shade(solids, opaque, lamps, other, above, away, beyond, spread * (1 + t / max(beyond, LIFT))), share


@nb.njit(cache=True, error_model="numpy")
def _ray(c2w, focal, principal, column, row):  # type: ignore[no-untyped-def]
    """Direction with camera z 1, so that distance along it is depth."""
    x, y = (column - principal[0]) / focal[0], (row - principal[1]) / focal[1]
    return (
        c2w[0, 0] * x + c2w[0, 1] * y + c2w[0, 2],
        c2w[1, 0] * x + c2w[1, 1] * y + c2w[1, 2],
        c2w[2, 0] * x + c2w[2, 1] * y + c2w[2, 2],
    )


@nb.njit(cache=True, error_model="numpy")
def _in_row(solids, c2w, focal, principal, row):  # type: ignore[no-untyped-def]
    """The solids that a row of pixels may show: the balls around them touch the plane of its rays."""
    slope = (row + 0.5 - principal[1]) / focal[1]
    found, count = np.empty(len(solids), np.int64), 0
    for i in range(len(solids)):
        x, y, z = solids[i, CX] - c2w[0, 3], solids[i, CX + 1] - c2w[1, 3], solids[i, CX + 2] - c2w[2, 3]
        down = c2w[0, 1] * x + c2w[1, 1] * y + c2w[2, 1] * z
        ahead = c2w[0, 2] * x + c2w[1, 2] * y + c2w[2, 2] * z
        away = abs(down - slope * ahead) / math.sqrt(1 + slope * slope)
        if away < math.sqrt(solids[i, BOUND]) + math.sqrt(x * x + y * y + z * z) / focal[1]:
            found[count] = i
            count += 1
    return found[:count]


@nb.njit(cache=True, error_model="numpy", parallel=True)
def measure_view(solids, c2w, lens, depth, face):  # type: ignore[no-untyped-def]
    """Fill `depth` [height, width] (camera z through each pixel's middle; 0: nothing hit) and `face` (a number
    for each face of each solid; -1: nothing). `lens` is (fx, fy) and (cx, cy) in pixels."""
    focal, principal = lens
    height, width = depth.shape
    origin = (c2w[0, 3], c2w[1, 3], c2w[2, 3])
    for row in nb.prange(height):
        candidates = _in_row(solids, c2w, focal, principal, row)
        for column in range(width):
            d = _ray(c2w, focal, principal, column + 0.5, row + 0.5)
            t, i = _nearest(solids, candidates, origin, d)
            depth[row, column], face[row, column] = 0.0, -1
            if i >= 0:
                _, n, _ = _outward(solids, i, (origin[0] + t * d[0], origin[1] + t * d[1], origin[2] + t * d[2]))
                flat = 0 if solids[i, KIND] == BALL else (1 if abs(n[0]) == 1 else (2 if abs(n[2]) == 1 else 3))
                depth[row, column], face[row, column] = t, 4 * i + flat


@nb.njit(cache=True, error_model="numpy", parallel=True)
def photograph_view(solids, light, c2w, lens, seen, image, samples):  # type: ignore[no-untyped-def]
    """Fill `image` [height, width, 3] (sRGB, 0 to 1).

    `solids` [n, TABLE_COLUMNS]. `light` is the rows that cast shadows and the lamp's points [n, 3]. `lens` is
    (fx, fy) and (cx, cy) in pixels. `seen` is the depth and the faces from `measure_view`. A pixel where faces meet
    is the mean of `samples`² rays. Elsewhere one ray is enough, since the paints fade out detail finer than a pixel.
    """
    opaque, lamps = light
    focal, principal = lens
    depth, face = seen
    everything = np.arange(len(solids))
    height, width = depth.shape
    origin = (c2w[0, 3], c2w[1, 3], c2w[2, 3])
    for row in nb.prange(height):
        candidates = _in_row(solids, c2w, focal, principal, row)
        for column in range(width):
            own, edge = face[row, column], False
            for r in range(max(0, row - 1), min(height, row + 2)):
                for c in range(max(0, column - 1), min(width, column + 2)):
                    edge |= face[r, c] != own
            rays = samples if edge else 1
            red, green, blue = 0.0, 0.0, 0.0
            for sample in range(rays * rays):
                x, y = column + (sample % rays + 0.5) / rays, row + (sample // rays + 0.5) / rays
                d = _ray(c2w, focal, principal, x, y)
                t, i = _nearest(solids, candidates, origin, d) if edge else (depth[row, column], own // 4)
                if i >= 0:
                    colour = _shade(solids, opaque, lamps, i, origin, d, t, 1.0 / focal[0])
                    if solids[i, GLOSS] > 0:
                        mirrored, share = _mirrored(solids, light, everything, i, origin, d, t, 1.0 / focal[0])
                        colour = (
                            colour[0] + share * (mirrored[0] - colour[0]),
                            colour[1] + share * (mirrored[1] - colour[1]),
                            colour[2] + share * (mirrored[2] - colour[2]),
                        )
                    red, green, blue = red + colour[0], green + colour[1], blue + colour[2]
            for channel, value in enumerate((red, green, blue)):
                linear = min(1.0, max(0.0, value / (rays * rays)))
                encoded = 12.92 * linear if linear < 0.0031308 else 1.055 * linear ** (1 / 2.4) - 0.055
                image[row, column, channel] = encoded
