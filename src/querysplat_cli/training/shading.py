"""The photograph of ray-cast solids, compiled: light, shadows, mirrors, and the colour of each pixel."""

import math

import numba as nb
import numpy as np

from querysplat_cli.training.raycast import (
    BALL,
    CYLINDER,
    FIRST,
    GLOSS,
    GRAIN,
    KIND,
    PAINT,
    RUN,
    SECOND,
    SEED,
    SX,
    distance,
    eye_of,
    in_run,
    nearest,
    outward,
    ray,
    touching,
)
from querysplat_cli.training.textures import paint

RED1, RED2 = FIRST.start, SECOND.start
BRIGHTNESS = 6.0
LIFT = 1e-4
"""How far above its surface a shadow ray starts, in metres."""


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
            lit = distance(solids, i, place, to, square) >= 1.0
        if lit:
            light, seen = light + cosine / (1.0 + square), seen + 1
    return light / len(lamps)


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
def _shade(solids, opaque, lamps, i, origin, direction, t, spread):  # type: ignore[no-untyped-def]
    """Linear RGB that leaves solid i towards the eye: Lambert's law with soft shadows.

    `spread` is the width of what the ray stands for, at distance 1.
    """
    place = (origin[0] + t * direction[0], origin[1] + t * direction[1], origin[2] + t * direction[2])
    point, n, normal = outward(solids, i, place)
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
def _mirrored(solids, everything, light, i, origin, direction, t, spread):  # type: ignore[no-untyped-def]
    """Linear RGB that a glossy solid i reflects towards the eye, and its share of what leaves it (Schlick).

    What it shows is lit but reflects nothing itself. Where the mirrored ray meets nothing, it is black.
    """
    opaque, lamps, _ = light
    place = (origin[0] + t * direction[0], origin[1] + t * direction[1], origin[2] + t * direction[2])
    _, _, normal = outward(solids, i, place)
    length = math.sqrt(direction[0] ** 2 + direction[1] ** 2 + direction[2] ** 2)
    along = direction[0] * normal[0] + direction[1] * normal[1] + direction[2] * normal[2]
    share = solids[i, GLOSS] + (1 - solids[i, GLOSS]) * (1 - min(1.0, abs(along) / length)) ** 5
    above = (place[0] + LIFT * normal[0], place[1] + LIFT * normal[1], place[2] + LIFT * normal[2])
    away = (
        direction[0] - 2 * along * normal[0],
        direction[1] - 2 * along * normal[1],
        direction[2] - 2 * along * normal[2],
    )
    beyond, other = nearest(solids, everything, above, away)
    if other < 0:
        return (0.0, 0.0, 0.0), share
    return _shade(solids, opaque, lamps, other, above, away, beyond, spread * (1 + t / max(beyond, LIFT))), share


@nb.njit(cache=True, error_model="numpy")
def _edge(face, row, column):  # type: ignore[no-untyped-def]
    """Whether a neighbour of the pixel shows another face."""
    height, width = face.shape
    for r in range(max(0, row - 1), min(height, row + 2)):
        for c in range(max(0, column - 1), min(width, column + 2)):
            if face[r, c] != face[row, column]:
                return True
    return False


@nb.njit(cache=True, error_model="numpy")
def _trace(solids, everything, camera, seen, row, first, samples, hits):  # type: ignore[no-untyped-def]
    """Fill `hits` with what each ray of a run of pixels meets: its direction, distance and solid (-1: nothing).

    `hits` [RUN, samples², 5] has one ray of pixels that are no edge; the others are not filled. Returns the number of
    rays of each pixel [RUN] (0 beyond the picture), and the box [2, 3] around all places that were met.
    """
    depth, face = seen
    counts, box = np.zeros(RUN, np.int64), np.empty((2, 3))
    box[0], box[1] = np.inf, -np.inf
    origin, candidates = eye_of(camera), in_run(solids, everything, camera, first, row)
    for number in range(min(RUN, depth.shape[1] - first)):
        column = first + number
        edge = _edge(face, row, column)
        rays = samples if edge else 1
        counts[number] = rays * rays
        for sample in range(rays * rays):
            x, y = column + (sample % rays + 0.5) / rays, row + (sample // rays + 0.5) / rays
            d = ray(camera, x, y)
            t, i = nearest(solids, candidates, origin, d) if edge else (depth[row, column], face[row, column] // 4)
            hit = hits[number, sample]
            hit[0], hit[1], hit[2], hit[3], hit[4] = d[0], d[1], d[2], t, i
            for axis in range(3 if i >= 0 else 0):
                place = origin[axis] + t * d[axis]
                box[0, axis], box[1, axis] = min(box[0, axis], place), max(box[1, axis], place)
    return counts, box


@nb.njit(cache=True, error_model="numpy")
def _in_the_way(solids, light, box):  # type: ignore[no-untyped-def]
    """The shadow casters that may hide a point of the lamp from a place in the box."""
    opaque, _, lamp = light
    middle = (box[0] + box[1]) / 2
    radius = math.sqrt(((box[1] - box[0]) ** 2).sum()) / 2 + LIFT
    return touching(solids, opaque, middle, lamp[:3] - middle, 1.0, (max(radius, lamp[3]), 0.0))


@nb.njit(cache=True, error_model="numpy")
def _colour(solids, everything, light, opaque, origin, hit, spread):  # type: ignore[no-untyped-def]
    """Linear RGB that comes along a ray of `_trace`. Only `opaque` may hide the lamp from where the ray ends."""
    d, t, i = (hit[0], hit[1], hit[2]), hit[3], int(hit[4])
    if i < 0:
        return 0.0, 0.0, 0.0
    colour = _shade(solids, opaque, light[1], i, origin, d, t, spread)
    if solids[i, GLOSS] <= 0:
        return colour
    mirrored, share = _mirrored(solids, everything, light, i, origin, d, t, spread)
    return (
        colour[0] + share * (mirrored[0] - colour[0]),
        colour[1] + share * (mirrored[1] - colour[1]),
        colour[2] + share * (mirrored[2] - colour[2]),
    )


@nb.njit(cache=True, error_model="numpy", parallel=True)
def photograph_view(solids, light, camera, seen, image, samples):  # type: ignore[no-untyped-def]
    """Fill `image` [height, width, 3] (sRGB, 0 to 1).

    `solids` [n, TABLE_COLUMNS]. `light` is the rows that cast shadows, the lamp's points [n, 3], and the middle and
    radius [4] of the ball around these. `camera` is c2w, and (fx, fy, cx, cy) in pixels. `seen` is the depth and the
    faces from `measure_view`. A pixel where faces meet is the mean of `samples`² rays. Elsewhere one ray is enough,
    since the paints fade out detail finer than a pixel.
    """
    height, width = seen[0].shape
    origin, spread, everything = eye_of(camera), 1.0 / camera[1][0], np.arange(len(solids))
    for row in nb.prange(height):
        hits = np.empty((RUN, samples * samples, 5))
        for first in range(0, width, RUN):
            counts, box = _trace(solids, everything, camera, seen, row, first, samples, hits)
            opaque = _in_the_way(solids, light, box)
            for number in range(min(RUN, width - first)):
                red, green, blue = 0.0, 0.0, 0.0
                for sample in range(counts[number]):
                    colour = _colour(solids, everything, light, opaque, origin, hits[number, sample], spread)
                    red, green, blue = red + colour[0], green + colour[1], blue + colour[2]
                for channel, value in enumerate((red, green, blue)):
                    linear = min(1.0, max(0.0, value / counts[number]))
                    encoded = 12.92 * linear if linear < 0.0031308 else 1.055 * linear ** (1 / 2.4) - 0.055
                    image[row, first + number, channel] = encoded
