"""The pixels of one tile, compiled: row by row in `scratch`, where LLVM can keep them in registers.

Loops go over all pixels at once. Those of two levels, or of as few steps as a tile is wide, do not become vectors.
"""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False
import numba as nb
import numpy as np

from querysplat_cli.splat.compiled_memory import copy, pointer
from querysplat_cli.splat.compiled_tiles import HIGH, WIDE, ZERO

PIXELS = WIDE * HIGH
BLENDED_PLANES = 5
"""The values that are blended: red, green, blue, 1 (for alpha) and z."""
PLANE_PIXELS = BLENDED_PLANES * PIXELS
ONE = np.float32(1)


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def let_light_in(light, rows, wide, high):
    """1 for each pixel that lies in the picture and −1 for the others, and the row of each in the tile."""
    through, ys = nb.carray(light, PIXELS), nb.carray(rows, PIXELS)
    for p in range(PIXELS):
        ys[p] = np.float32(p // WIDE)
        through[p] = ONE if p % WIDE < wide and p // WIDE < high else -ONE


@nb.njit(cache=True, error_model="numpy", fastmath={"reassoc"}, forceinline=True)
def any_open(light):
    """Whether light comes through any of the pixels."""
    through, most = nb.carray(light, PIXELS), ZERO
    for p in range(PIXELS):
        most += max(through[p], ZERO)
    return most > ZERO


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def clear(tile):
    """Set the pixels of all planes to 0."""
    numbers = nb.carray(tile, PLANE_PIXELS)
    for p in range(PLANE_PIXELS):
        numbers[p] = ZERO


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def fill_alpha(tile, light):
    """Fill the plane of alpha from what comes through each pixel, negative where it has stopped."""
    numbers, through = nb.carray(tile, PLANE_PIXELS), nb.carray(light, PIXELS)
    for p in range(PIXELS):
        numbers[3 * PIXELS + p] = ONE - abs(through[p])


@nb.njit(cache=True, error_model="numpy", fastmath={"contract"}, forceinline=True)
def fill_products(products, one, other):
    """Fill the sums over all planes of one tile times the other one."""
    sums, first, second = nb.carray(products, PIXELS), nb.carray(one, PLANE_PIXELS), nb.carray(other, PLANE_PIXELS)
    for p in range(PIXELS):
        sums[p] = ZERO
        for plane in range(BLENDED_PLANES):
            sums[p] += first[plane * PIXELS + p] * second[plane * PIXELS + p]


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _copy_rows(tile, planes, left, top, wide, high, outwards):
    for plane in range(BLENDED_PLANES):
        for r in range(high):
            ours = plane * PIXELS + r * WIDE
            theirs = (plane * planes.shape[1] + top + r) * planes.shape[2] + left
            if outwards:
                copy(pointer(planes), theirs, tile, ours, wide)
            else:
                copy(tile, ours, pointer(planes), theirs, wide)


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def copy_tile(tile, planes, left, top, outwards):
    """Copy the pixels of a tile into planes [BLENDED_PLANES, height, width], or those of the planes into the tile."""
    wide, high = min(WIDE, planes.shape[2] - left), min(HIGH, planes.shape[1] - top)
    if wide == WIDE:  # known when this is compiled, so that a row is one vector
        _copy_rows(tile, planes, left, top, WIDE, high, outwards)
    else:
        _copy_rows(tile, planes, left, top, wide, high, outwards)
