"""Pixels judged by what other views measured along their rays (`transients.py`), compiled, on every core."""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False
import numba as nb

from querysplat_cli.queries.compiled_comparison import projected

AGREES, CONTRADICTS = 1, 2
"""Verdicts on a pixel: another view shows it, too; or nothing that other views saw can be it. 0 is neither."""


@nb.njit(error_model="numpy", inline="always")
def _difference(one, other):
    return max(abs(one[0] - other[0]), abs(one[1] - other[1]), abs(one[2] - other[2]))


@nb.njit(cache=True, error_model="numpy", parallel=True)
def judge_pixels(verdicts, rays, origin, reach, own, others, w2c, lenses, limits, depth, confidence, masks, colours):
    """Set verdicts [rows, columns] on pixels of one view, whose colours are `own` [rows, columns, 3].

    A place at the depth z on a ray is `origin` [3] + z times the pixel's ray [rows, columns, 3] in the world. `reach`
    has the first z, the last one, and the factor of a step. `others` [compared] are the views to compare with. `w2c` is
    [views, 4, 4], `lenses` [views, 4] fx, fy, cx and cy in pixels; depth, confidence, masks and colours are those of
    all views. `limits` are the least camera z and the policy's `same_depth`, `same_colour`, `perhaps`,
    `fewest_surfaces` and the confidence of measured depth.
    """
    rows, columns = verdicts.shape
    height, width = depth.shape[1:]
    nearest, same_depth, same_colour, perhaps, fewest, measured = limits
    for row in nb.prange(rows):
        for column in range(columns):
            if verdicts[row, column]:
                continue
            colour, ray = own[row, column], rays[row, column]
            z, possible = reach[0], False
            while z < reach[1]:
                through = alike = unlike = unknown = 0
                place = (origin[0] + z * ray[0], origin[1] + z * ray[1], origin[2] + z * ray[2])
                for other in others:
                    x, y, far = projected(place, w2c[other], lenses[other])
                    if not (far > nearest and 0 <= x < width and 0 <= y < height):
                        continue
                    there = int(y), int(x)
                    if not masks[other, there[0], there[1]]:
                        continue
                    difference = _difference(colour, colours[other, there[0], there[1]])
                    if confidence[other, there[0], there[1]] < measured:
                        unknown += difference < perhaps
                        continue
                    ratio = far / depth[other, there[0], there[1]]
                    if ratio < 1 - same_depth:
                        through += 1
                    elif ratio < 1 + same_depth:
                        alike += difference < same_colour
                        unlike += difference >= same_colour
                if alike:
                    verdicts[row, column] = AGREES
                    break
                if unlike >= fewest:
                    if not possible:
                        verdicts[row, column] = CONTRADICTS
                    break
                possible |= unknown > through
                z *= reach[2]
