"""The kernels of the depth are compiled ahead with the types with which they are called."""

from synthetic import arc, photographs, room

from querysplat_cli.encoders.base import CameraRequest
from querysplat_cli.encoders.classical.encoder import ClassicalEncoder
from querysplat_cli.encoders.classical.kernels import KERNELS
from querysplat_cli.encoders.classical.search import AUTOMATIC
from querysplat_cli.runtime.compiler import DEPTH_KERNELS, compile_here, is_compiled
from querysplat_cli.runtime.progress import silent


def test_nothing_is_left_to_compile() -> None:
    for module in DEPTH_KERNELS:
        compile_here(module)
    before = [list(function.signatures) for function, _ in KERNELS]
    assert all(before)
    encoder = ClassicalEncoder(AUTOMATIC)
    posed = encoder.estimate_cameras(photographs(room(), arc(4)), CameraRequest(128, 0, None), silent)
    encoder.estimate_geometry(posed, seed=0, progress=silent)
    assert [list(function.signatures) for function, _ in KERNELS] == before
    assert all(is_compiled(module) for module in DEPTH_KERNELS)
