"""The kernels of attention, with their types, in the order of their first call."""

from numba import float32, int64

from querysplat_cli.model.compiled_attention import attend_forward, backward_to_memory, backward_to_queries

F2, F3, L2 = float32[:, ::1], float32[:, :, ::1], int64[:, ::1]
KERNELS = (
    (attend_forward, (F3, F3, F3, L2, F2, F3, F3)),
    (backward_to_queries, (F3, F3, F3, L2, F3, F3, F3, F3)),
    (backward_to_memory, (F3, L2, F3, F3, F3, F3, F3)),
)
