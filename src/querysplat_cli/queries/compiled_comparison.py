"""Cells compared with other views, and covered by their cells (`coverage.py`), compiled, on every core."""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False
import numba as nb


@nb.njit(error_model="numpy", inline="always")
def projected(point, w2c, lens):
    """Pixels x and y, and camera z, of one point [3] in world coordinates. Behind the camera, pixels mean nothing."""
    px, py, pz = point[0], point[1], point[2]
    z = w2c[2, 0] * px + w2c[2, 1] * py + w2c[2, 2] * pz + w2c[2, 3]
    x = (w2c[0, 0] * px + w2c[0, 1] * py + w2c[0, 2] * pz + w2c[0, 3]) / z * lens[0] + lens[2]
    y = (w2c[1, 0] * px + w2c[1, 1] * py + w2c[1, 2] * pz + w2c[1, 3]) / z * lens[1] + lens[3]
    return x, y, z


@nb.njit(cache=True, error_model="numpy", parallel=True)
def compare_cells(points, others, w2c, lenses, limits, depth, confidence, masks, images, counts, colours):
    """Add what other views say of each cell to counts [views, cells, 2] and colours [views, cells, 4].

    points [views, cells, 3] are in world coordinates, and others [views, compared] names the views that each view is
    compared with. w2c is [views, 4, 4], lenses [views, 4] holds fx, fy, cx, cy in pixels. `limits` are the least camera
    z, and `depth_agreement`, `free_space` and `confident` of the query policy.

    Counts are the summed confidence of views that see the same surface, and the views whose measured surface the cell
    would hide. Colours are weighted sums of red, green and blue, and the weights.
    """
    views, cells = points.shape[:2]
    height, width = depth.shape[1:]
    nearest, agreement, free_space, confident = limits
    one = points.dtype.type(1)
    for place in nb.prange(views * cells):
        own, cell = place // cells, place % cells
        for other in others[own]:
            if other == own:
                continue
            x, y, z = projected(points[own, cell], w2c[other], lenses[other])
            if not (z > nearest and 0 <= x < width and 0 <= y < height):
                continue
            row, column = int(y), int(x)
            if not masks[other, row, column]:
                continue
            surface, sure = depth[other, row, column], confidence[other, row, column]
            if abs(z / surface - one) < agreement:
                counts[own, cell, 0] += sure
                for channel in range(3):
                    colours[own, cell, channel] += sure * images[other, channel, row, column]
                colours[own, cell, 3] += sure
            if z < surface * (one - free_space) and sure > confident:
                counts[own, cell, 1] += one


@nb.njit(cache=True, error_model="numpy", parallel=True)
def mark_covered(points, footprint, keep, w2c, lens, limits, cell, depth, size, hits):
    """Set hits [rows, columns] to 1 at the cells of a view whose surface a cell of a block in `keep` covers.

    points [blocks, cells, 3] are in world coordinates, with their footprints [blocks, cells]. The view has w2c [4, 4],
    a `lens` of fx, fy, cx, cy in pixels, and the depth and the footprint `size` of its own cells, of `cell` pixels.
    `limits` are the least camera z, and `depth_agreement` and `coarser` of the query policy.
    """
    nearest, agreement, coarser = limits
    rows, columns = depth.shape
    one = points.dtype.type(1)
    for block in nb.prange(len(points)):
        if not keep[block]:
            continue
        for part in range(points.shape[1]):
            x, y, z = projected(points[block, part], w2c, lens)
            x, y = x / cell, y / cell
            if not (z > nearest and 0 <= x < columns and 0 <= y < rows):
                continue
            row, column = int(y), int(x)
            same = abs(z / depth[row, column] - one) < agreement
            if same and footprint[block, part] < coarser * size[row, column]:
                hits[row, column] = one  # by several threads at once, all of the same value
