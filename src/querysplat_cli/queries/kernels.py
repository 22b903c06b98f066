"""The kernels of the queries, with their types, in the order of their first call."""

from numba import boolean, float32, float64, int64, types

from querysplat_cli.queries.compiled_comparison import compare_cells, mark_covered

F1, F2, F3, F4 = float32[::1], float32[:, ::1], float32[:, :, ::1], float32[:, :, :, ::1]
THREE, FOUR = types.UniTuple(float64, 3), types.UniTuple(float64, 4)
KERNELS = (
    (compare_cells, (F3, int64[:, ::1], F3, F2, FOUR, F3, F3, boolean[:, :, ::1], F4, F3, F3)),
    (mark_covered, (F3, F2, boolean[::1], F2, F1, THREE, int64, F2, F2, F2)),
)
