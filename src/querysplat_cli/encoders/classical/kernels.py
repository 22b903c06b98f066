"""The kernels of the depth, with their types, in the order of their first call."""

from numba import boolean, float32, float64, int64, uint8, uint16

from querysplat_cli.encoders.classical.consistency import _carve_view, _lend, _vote
from querysplat_cli.encoders.classical.patchmatch import _improve
from querysplat_cli.encoders.classical.semiglobal import _best_planes, _two_passes
from querysplat_cli.encoders.classical.sweep import _sweep

F2, F3, F4 = float32[:, ::1], float32[:, :, ::1], float32[:, :, :, ::1]
D1, D2, D3, L1 = float64[::1], float64[:, ::1], float64[:, :, ::1], int64[::1]
KERNELS = (
    (_sweep, (F2, F3, F4, uint8[:, :, ::1])),
    (_two_passes, (uint8[:, :, ::1], F2, uint16[:, :, :, ::1])),
    (_best_planes, (uint16[:, :, ::1], F2)),
    (_improve, (F3, int64, int64, F2, F3, F2, F2, F3, F2, float32, float32)),
    (_vote, (F2, F3, F2, L1, D3, D2, D1)),
    (_lend, (F2, F3, F2, F2, F3, D2, D1)),
    (_carve_view, (F2, boolean[:, ::1], F3, F3, F3, F4, L1, D3, D2, float64)),
)
