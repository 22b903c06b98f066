"""The default encoder: classical structure from motion and multi-view stereo. It needs no weights."""

from collections.abc import Mapping, Sequence

from querysplat_cli.encoders.base import EncoderOptions, Geometry, PosedViews
from querysplat_cli.encoders.classical.cameras import estimate_cameras
from querysplat_cli.runtime.progress import Progress
from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.views import Photo


class ClassicalEncoder:
    """SIFT and incremental mapping for the cameras, a plane sweep for the depth."""

    name = "classical"
    size = 448
    own_frame = False

    def estimate_cameras(
        self,
        photos: Sequence[Photo],
        *,
        max_size: int,
        seed: int,
        progress: Progress,
        known: Mapping[str, PhotoCamera] | None = None,
    ) -> PosedViews:
        """See `querysplat_cli.encoders.classical.cameras.estimate_cameras`."""
        return estimate_cameras(photos, max_size=max_size, seed=seed, progress=progress, known=known)

    def estimate_geometry(self, posed: PosedViews, *, seed: int, progress: Progress) -> Geometry:
        """See `querysplat_cli.encoders.classical.depth.estimate_geometry`."""
        # Imported here: the depth's compiled kernels are not needed by those who only want cameras.
        from querysplat_cli.encoders.classical.depth import estimate_geometry

        return estimate_geometry(posed, seed=seed, progress=progress)

    def free(self) -> None:
        """There is nothing to give back."""

    def bytes_needed(self, views: int, size: int) -> int | None:
        """Unknown: under 2 GiB for twenty photos."""
        return None


def make(options: EncoderOptions) -> ClassicalEncoder:
    """No option changes anything."""
    return ClassicalEncoder()
