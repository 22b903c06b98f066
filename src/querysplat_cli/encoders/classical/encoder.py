"""The default encoder: classical structure from motion and multi-view stereo. It needs no weights."""

from collections.abc import Sequence

from querysplat_cli.encoders.base import CameraRequest, EncoderOptions, Geometry, PosedViews
from querysplat_cli.encoders.classical.cameras import estimate_cameras
from querysplat_cli.runtime.progress import Progress
from querysplat_cli.scene.views import Photo


class ClassicalEncoder:
    """SIFT and incremental mapping for the cameras; a plane sweep and PatchMatch for the depth."""

    name = "classical"
    size = 448
    own_frame = False

    def estimate_cameras(self, photos: Sequence[Photo], request: CameraRequest, progress: Progress) -> PosedViews:
        """See `querysplat_cli.encoders.classical.cameras.estimate_cameras`."""
        return estimate_cameras(photos, request, progress)

    def estimate_geometry(self, posed: PosedViews, *, seed: int, progress: Progress) -> Geometry:
        """See `querysplat_cli.encoders.classical.depth.estimate_geometry`."""
        # Imported here: whoever wants only cameras does not need the compiled kernels of the depth.
        from querysplat_cli.encoders.classical.depth import estimate_geometry

        return estimate_geometry(posed, seed=seed, progress=progress)

    def free(self) -> None:
        """Nothing is held."""

    def bytes_needed(self, views: int, size: int) -> int | None:
        """None: under 2 GiB for twenty photos."""
        return None


def make(options: EncoderOptions) -> ClassicalEncoder:
    """The classical encoder. No option changes anything."""
    return ClassicalEncoder()
