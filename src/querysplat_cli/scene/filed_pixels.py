"""Pixels of many photos in a file, which the system reads when they are looked at."""

import mmap
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import IO

import numpy as np

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.views import Photo


class FiledPixels:
    """Takes photos, and keeps the pixels and masks of those in a file for which `bytes_in_memory` are not enough.

    The file is on the disk of `folder`. It has no name, so nothing is left of it, however the process ends.
    """

    def __init__(self, folder: Path, bytes_in_memory: int) -> None:
        self._folder, self._left, self._written = folder, bytes_in_memory, 0
        self._file: IO[bytes] | None = None

    def __call__(self, photo: Photo) -> Photo:
        """The same photo, whose arrays may lie in the file. Raises QuerySplatError when the disk is full."""
        self._left -= photo.pixels.nbytes + (0 if photo.mask is None else photo.mask.nbytes)
        if self._left >= 0:
            return photo
        mask = None if photo.mask is None else self._filed(photo.mask)
        return replace(photo, pixels=self._filed(photo.pixels), mask=mask)

    def _filed(self, array: np.ndarray) -> np.ndarray:
        try:
            self._file = self._file or tempfile.TemporaryFile(dir=self._folder)  # noqa: SIM115 - the maps need it
            np.ascontiguousarray(array).tofile(self._file)
            self._file.flush()
        except OSError as error:
            why = f"{self._folder}: no room for the pixels of all photos: {error.strerror or error}"
            raise QuerySplatError(why, "Free some space, or choose an output on another disk.") from None
        # Copy on write: torch warns of arrays that cannot be written.
        filed = np.memmap(self._file, array.dtype, "c", self._written, array.shape)
        self._written += array.nbytes
        return filed


def release(photo: Photo) -> None:
    """Free the memory of pixels and masks that lie in a file. They are read again where they are looked at again."""
    for array in (photo.pixels, photo.mask):
        if array is not None and isinstance(array.base, mmap.mmap) and hasattr(mmap, "MADV_DONTNEED"):
            array.base.madvise(mmap.MADV_DONTNEED)
