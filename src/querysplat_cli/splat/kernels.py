"""The kernels of `cpu.py` and of the loss, with their types, in the order of their first call."""

from numba import boolean, float32, float64, int32, int64, types, uint32

from querysplat_cli.splat import compiled_blending as blending
from querysplat_cli.splat import compiled_projection as projection
from querysplat_cli.splat import compiled_projection_backward as projection_backward
from querysplat_cli.splat import compiled_similarity as similarity
from querysplat_cli.splat import compiled_tiles as tiles

F1, F2, F3, F4 = float32[::1], float32[:, ::1], float32[:, :, ::1], float32[:, :, :, ::1]
D1, D2, I1, I2, L1, L2 = float64[::1], float64[:, ::1], int32[::1], int32[:, ::1], int64[::1], int64[:, ::1]
GAUSSIANS = types.Tuple((F2, F2, F2, F1, F3))
KERNELS = (
    (projection.project_view, (GAUSSIANS, D1, D1, F2, F1)),
    (projection.by_depth, (uint32[::1],)),
    (tiles.tile_rows, (F2, I1, int64, I1, I1)),
    (tiles.find_spans, (F2, I1, I1, L1, float64, int64, I2, L2)),
    (tiles.deal, (I1, I1, L1, I2, int64, int64, int64, L1, I1)),
    (blending.blend, (F2, L1, I1, int64, F1, F3)),
    (similarity.photometric_sums, (F4, F4, boolean[:, :, ::1], D1, float64, F1, int64, D2, F4)),
    (blending.blend_backward, (F2, L1, I1, L1, int64, F1, F3, F3, F3)),
    (projection_backward.project_view_backward, (GAUSSIANS, D1, D1, F2, F3, GAUSSIANS, D2, boolean)),
)
