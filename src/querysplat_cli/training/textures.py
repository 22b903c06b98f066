"""Paints of the procedural scenes, compiled: linear RGB as a function of a point on a surface.

Every paint has detail at all scales down to about a centimetre, so that it can be matched between photos.
Detail finer than the pixel's `footprint` (metres) fades out, which keeps the pictures free of moiré.
"""

import math

import numba as nb
import numpy as np

PAINTS = ("plaster", "brick", "planks", "tiles", "poster", "rug", "marble", "books", "leaves", "plain")
"""A paint's number is its index here."""


@nb.njit(cache=True, error_model="numpy")
def paint(number, point, face, colours, grain, seed, footprint):  # type: ignore[no-untyped-def]
    """Linear RGB of paint `number`.

    `point` is x, y, z in the solid's own frame. `face` is u, v from the middle of the point's face, and the face's
    width and height. Lengths are in metres. `colours` are the paint's two colours, `grain` is the scale of its
    pattern (1: as in reality), and `seed` differs between solids of one paint.
    """
    u, v, width, height = face
    first, second = colours
    x, y, z = point[0] / grain, point[1] / grain, point[2] / grain
    fine = footprint / grain
    a, b = u / grain, v / grain
    if number == 1:
        return _brick(x, y, z, a, b, first, second, seed, fine)
    if number == 2:
        return _planks(a, b, first, second, seed, fine)
    if number == 3:
        return _tiles(x, y, z, a, b, first, second, seed, fine)
    if number == 4:
        return _poster(x, y, z, u / width + 0.5, v / height + 0.5, height / width, second, seed, fine)
    if number == 5:
        return _rug(x, y, z, a, b, u / width, v / height, first, second, seed, fine)
    if number == 6:
        return _marble(x, y, z, first, second, seed, fine)
    if number == 7:
        return _books(x, y, z, a, v / height + 0.5, first, seed, fine)
    if number == 8:
        return _leaves(x, y, z, first, second, seed, fine)
    if number == 9:
        return _mix(first, second, _clouds(x, y, z, 11.0, 6, seed, fine))
    return _plaster(x, y, z, first, second, seed, fine)


@nb.njit(cache=True, error_model="numpy")
def chance(i, j, k, seed):  # type: ignore[no-untyped-def]
    """A pseudo-random number in [0, 1) from three integers and a seed."""
    # Odd constants and shifts in the manner of integer finalisers; wraps around in 64 bits.
    h = np.uint64(i) * np.uint64(0x9E3779B97F4A7C15) + np.uint64(j) * np.uint64(0xC2B2AE3D27D4EB4F)
    h += np.uint64(k) * np.uint64(0x165667B19E3779F9) + np.uint64(seed) * np.uint64(0x27D4EB2F165667C5)
    h ^= h >> np.uint64(32)
    h *= np.uint64(0xD6E8FEB86659FD93)
    h ^= h >> np.uint64(29)
    h *= np.uint64(0xD6E8FEB86659FD93)
    h ^= h >> np.uint64(32)
    return np.float64(h >> np.uint64(40)) * (1.0 / 16777216.0)


@nb.njit(cache=True, error_model="numpy")
def _noise(x, y, z, seed):  # type: ignore[no-untyped-def]
    """Smooth noise in [0, 1] with features of unit size, interpolated between `chance` at integer points."""
    fx, fy, fz = math.floor(x), math.floor(y), math.floor(z)
    i, j, k = np.int64(fx), np.int64(fy), np.int64(fz)
    x, y, z = x - fx, y - fy, z - fz
    x, y, z = x * x * (3 - 2 * x), y * y * (3 - 2 * y), z * z * (3 - 2 * z)
    c00 = chance(i, j, k, seed) * (1 - x) + chance(i + 1, j, k, seed) * x
    c10 = chance(i, j + 1, k, seed) * (1 - x) + chance(i + 1, j + 1, k, seed) * x
    c01 = chance(i, j, k + 1, seed) * (1 - x) + chance(i + 1, j, k + 1, seed) * x
    c11 = chance(i, j + 1, k + 1, seed) * (1 - x) + chance(i + 1, j + 1, k + 1, seed) * x
    return (c00 * (1 - y) + c10 * y) * (1 - z) + (c01 * (1 - y) + c11 * y) * z


@nb.njit(cache=True, error_model="numpy")
def _clouds(x, y, z, frequency, octaves, seed, fine):  # type: ignore[no-untyped-def]
    """Octaves of noise around 0.5, each finer one weaker; those finer than the footprint are left out."""
    total, weight = 0.0, 0.5
    for octave in range(octaves):
        visible = min(1.0, 2.0 - 3.0 * fine * frequency)
        if visible <= 0:
            break
        total += weight * visible * (_noise(x * frequency, y * frequency, z * frequency, seed + octave) - 0.5)
        frequency *= 2.1
        weight *= 0.72
    return min(1.0, max(0.0, 0.5 + 1.1 * total))


@nb.njit(cache=True, error_model="numpy")
def _step(edge, value, fine):  # type: ignore[no-untyped-def]
    """0 below the edge, 1 above, with a ramp as wide as the footprint."""
    ramp = max(fine, 1e-4)
    return min(1.0, max(0.0, (value - edge) / ramp + 0.5))


@nb.njit(cache=True, error_model="numpy")
def _mix(first, second, share):  # type: ignore[no-untyped-def]
    return (
        first[0] + (second[0] - first[0]) * share,
        first[1] + (second[1] - first[1]) * share,
        first[2] + (second[2] - first[2]) * share,
    )


@nb.njit(cache=True, error_model="numpy")
def _times(colour, factor):  # type: ignore[no-untyped-def]
    return colour[0] * factor, colour[1] * factor, colour[2] * factor


@nb.njit(cache=True, error_model="numpy")
def _hue(value, strength):  # type: ignore[no-untyped-def]
    """A colour of the given hue (one turn is 1) around a warm middle tone."""
    return (
        0.34 + strength * math.cos(2 * math.pi * value),
        0.28 + strength * math.cos(2 * math.pi * (value - 0.32)),
        0.22 + strength * math.cos(2 * math.pi * (value - 0.58)),
    )


@nb.njit(cache=True, error_model="numpy")
def _plaster(x, y, z, first, second, seed, fine):  # type: ignore[no-untyped-def]
    colour = _mix(first, second, _clouds(x, y, z, 2.6, 7, seed, fine))
    bent = 0.25 * _clouds(x, y, z, 20.0, 2, seed + 13, fine)
    speckle = _noise(x * 37 + 5 * bent, y * 37 - 5 * bent, z * 37 + 3 * bent, seed + 11)
    dots = _step(0.72, speckle, 0.25 + 12 * fine) * min(1.0, max(0.0, 1.6 - 30 * fine))
    return _times(colour, 1.0 - 0.35 * dots)


@nb.njit(cache=True, error_model="numpy")
def _brick(x, y, z, a, b, first, second, seed, fine):  # type: ignore[no-untyped-def]
    row = math.floor(b / 0.085)
    along = a / 0.26 + 0.5 * (np.int64(row) & 1) + 0.12 * chance(np.int64(row), 0, 0, seed + 5)
    column = math.floor(along)
    edge = min(min(along - column, column + 1 - along) * 0.26, min(b - row * 0.085, (row + 1) * 0.085 - b))
    wobble = 0.004 * (_noise(x * 40, y * 40, z * 40, seed + 3) - 0.5)
    solid = _step(0.006, edge + wobble, fine)
    tint = 0.55 + 0.8 * chance(np.int64(column), np.int64(row), 1, seed)
    warm = chance(np.int64(column), np.int64(row), 2, seed)
    stone = _times(_mix(first, second, 0.45 * warm), tint * (0.55 + 0.9 * _clouds(x, y, z, 11.0, 5, seed, fine)))
    mortar = _times((0.42, 0.40, 0.37), 0.7 + 0.6 * _clouds(x, y, z, 25.0, 3, seed + 9, fine))
    return _mix(mortar, stone, solid)


@nb.njit(cache=True, error_model="numpy")
def _planks(a, b, first, second, seed, fine):  # type: ignore[no-untyped-def]
    row = math.floor(b / 0.15)
    along = a / 1.1 + chance(np.int64(row), 3, 0, seed)
    column = math.floor(along)
    edge = min(min(along - column, column + 1 - along) * 1.1, min(b - row * 0.15, (row + 1) * 0.15 - b))
    own = seed + 17 * np.int64(row) + 131 * np.int64(column)
    bend = 0.05 * _noise(a * 2.5, b * 5.0, 0.5, own)
    rings = _clouds(a * 0.16, (b + bend) * 1.9, 0.5, 14.0, 5, own, fine)
    pores = _noise(a * 14, b * 120, 0.5, own + 7) * min(1.0, max(0.0, 1.5 - 60 * fine))
    colour = _times(_mix(first, second, rings), 0.72 + 0.5 * chance(np.int64(row), np.int64(column), 4, seed))
    knot = _noise(a * 5, b * 9, 1.5, own + 2)
    colour = _times(colour, (1.0 - 0.25 * pores) * (1.0 - 0.55 * _step(0.80, knot, 0.06 + 9 * fine)))
    return _times(colour, 0.35 + 0.65 * _step(0.003, edge, fine))


@nb.njit(cache=True, error_model="numpy")
def _tiles(x, y, z, a, b, first, second, seed, fine):  # type: ignore[no-untyped-def]
    size = 0.33
    i, j = math.floor(a / size), math.floor(b / size)
    edge = min(min(a - i * size, (i + 1) * size - a), min(b - j * size, (j + 1) * size - b))
    odd = (np.int64(i) + np.int64(j)) & 1
    own = seed + 13 * np.int64(i) + 101 * np.int64(j)
    veins = _clouds(x + 3 * chance(np.int64(i), np.int64(j), 0, seed), y, z, 5.0, 6, own, fine)
    base = _mix(first, second, 0.1 + 0.8 * odd)
    tint = 0.75 + 0.4 * chance(np.int64(i), np.int64(j), 1, seed)
    stone = _times(base, tint * (0.45 + 1.1 * veins))
    return _mix((0.24, 0.23, 0.22), stone, _step(0.005, edge, fine))


@nb.njit(cache=True, error_model="numpy")
def _poster(x, y, z, s, t, aspect, second, seed, fine):  # type: ignore[no-untyped-def]
    """A framed print: shapes in a grid, each of its own colours."""
    rim = min(min(s, 1 - s), min(t, 1 - t) * aspect)
    frame = _times(second, 0.4 + 0.3 * _clouds(x, y, z, 20.0, 3, seed, fine))
    paper = _times((0.80, 0.77, 0.70), 0.9 + 0.2 * _clouds(x, y, z, 30.0, 3, seed, fine))
    frame = _mix(frame, paper, _step(0.025, rim, fine))
    if rim < 0.07:
        return frame
    columns = 3 + np.int64(3 * chance(1, 2, 3, seed))
    rows = max(2, np.int64(columns * aspect + 0.5))
    p, q = (s - 0.075) / 0.85 * columns, (t - 0.075 / aspect) / (1 - 0.15 / aspect) * rows
    i, j = np.int64(math.floor(p)), np.int64(math.floor(q))
    p, q = p - i - 0.5, q - j - 0.5
    kind = chance(i, j, 1, seed)
    ground = _hue(chance(i, j, 2, seed), 0.17)
    shape = _hue(chance(i, j, 3, seed) + 0.5, 0.20)
    soft = fine * columns * 1.5
    if kind < 0.3:
        inside = _step(0.0, 0.14 + 0.26 * chance(i, j, 4, seed) - math.hypot(p, q), soft)
    elif kind < 0.5:
        inside = _step(0.0, p * (1 if kind < 0.4 else -1) + q, soft)
    elif kind < 0.75:
        wave = math.sin((p if kind < 0.62 else q) * (12 + 16 * chance(i, j, 5, seed)))
        inside = _step(0.0, wave, soft * 20)
    else:
        inside = _step(0.28, abs(p) + abs(q), soft)
    strokes = 0.75 + 0.5 * _clouds(x, y, z, 18.0, 5, seed + 31, fine)
    return _mix(frame, _times(_mix(ground, shape, inside), strokes), _step(0.075, rim, fine))


@nb.njit(cache=True, error_model="numpy")
def _rug(x, y, z, a, b, s, t, first, second, seed, fine):  # type: ignore[no-untyped-def]
    rim = 0.5 - max(abs(s), abs(t))
    diamonds = abs((a * 3.1) % 1.0 - 0.5) + abs((b * 3.1) % 1.0 - 0.5)
    i, j = np.int64(math.floor(a * 3.1)), np.int64(math.floor(b * 3.1))
    figure = _step(0.32 + 0.16 * chance(i, j, 0, seed), diamonds, 4 * fine)
    accent = _hue(chance(i, j, 1, seed), 0.14)
    colour = _mix(_mix(accent, first, 0.35), second, figure)
    stripes = _mix(first, second, _step(0.0, math.sin(rim * 160), 80 * fine))
    colour = _mix(colour, stripes, _step(0.0, 0.09 - rim, 0.5 * fine))
    weave = 0.6 + 0.8 * _clouds(x, y, z, 16.0, 5, seed, fine)
    return _times(colour, weave)


@nb.njit(cache=True, error_model="numpy")
def _marble(x, y, z, first, second, seed, fine):  # type: ignore[no-untyped-def]
    fold = _clouds(x, y, z, 5.0, 5, seed, fine)
    vein = 1.0 - abs(math.sin(14.0 * fold + 9.0 * x + 5.0 * z))
    spots = _step(0.70, _noise(x * 34, y * 34, z * 34, seed + 23), 0.1 + 12 * fine)
    colour = _mix(first, second, min(1.0, vein * vein * 1.2))
    return _times(colour, (0.6 + 0.8 * _clouds(x, y, z, 13.0, 4, seed + 7, fine)) * (1 - 0.35 * spots))


@nb.njit(cache=True, error_model="numpy")
def _books(x, y, z, a, t, first, seed, fine):  # type: ignore[no-untyped-def]
    """A row of spines: each of its own width, height, colour and bands."""
    cell = math.floor(a / 0.11)
    split = 0.3 + 0.4 * chance(np.int64(cell), 1, 0, seed)
    along = a / 0.11 - cell
    right = along > split
    book = np.int64(2 * cell + (1 if right else 0))
    width = 1 - split if right else split
    place = (along - split if right else along) / width
    edge = min(place, 1 - place) * width * 0.11
    shade = 0.55 + 0.6 * chance(book, 6, 0, seed)
    colour = _times(_mix(_hue(chance(book, 2, 0, seed), 0.16), first, 0.25), shade)
    gold = _hue(chance(book, 5, 0, seed) * 0.2, 0.25)
    band = 0.15 + 0.25 * chance(book, 3, 0, seed)
    colour = _mix(colour, gold, _step(0.0, 0.03 - abs(t - band), 4 * fine))
    colour = _mix(colour, gold, _step(0.0, 0.02 - abs(t - 0.85), 4 * fine))
    letters = _noise(place * 4, t * 26, book * 1.7, seed + 41)
    title = _step(0.55, letters, 0.1 + 20 * fine) * (1.0 if 0.48 < t < 0.76 and 0.25 < place < 0.75 else 0.0)
    colour = _mix(colour, (0.75, 0.72, 0.62), title)
    top = 0.80 + 0.2 * chance(book, 4, 0, seed)
    colour = _times(colour, 1 - 0.9 * _step(top, t, 4 * fine))
    worn = 0.75 + 0.5 * _clouds(x, y, z, 22.0, 4, seed, fine)
    return _times(colour, worn * (0.25 + 0.75 * _step(0.004, edge, fine)))


@nb.njit(cache=True, error_model="numpy")
def _leaves(x, y, z, first, second, seed, fine):  # type: ignore[no-untyped-def]
    coarse = _clouds(x, y, z, 9.0, 3, seed, fine)
    blades = abs(_noise(x * 17 + 4 * coarse, y * 17, z * 30, seed + 5) - 0.5) * 2
    colour = _mix(first, second, min(1.0, 1.3 * blades))
    return _times(colour, 0.25 + 1.4 * coarse * coarse + 0.5 * blades)
