"""The kernels of the queries, with their types, in the order of their first call."""

from numba import boolean, float32, float64, int8, int64, types

from querysplat_cli.queries.compiled_comparison import compare_cells, mark_covered
from querysplat_cli.queries.compiled_transients import judge_pixels

F1, F2, F3, F4 = float32[::1], float32[:, ::1], float32[:, :, ::1], float32[:, :, :, ::1]
THREE, FOUR, SIX = (types.UniTuple(float64, count) for count in (3, 4, 6))
KERNELS = (
    (compare_cells, (F3, int64[:, ::1], F3, F2, FOUR, F3, F3, boolean[:, :, ::1], F4, F3, F3)),
    (mark_covered, (F3, F2, boolean[::1], F2, F1, THREE, int64, F2, F2, F2)),
    (judge_pixels, (int8[:, ::1], F3, F1, THREE, F3, int64[::1], F3, F2, SIX, F3, F3, boolean[:, :, ::1], F4)),
)
