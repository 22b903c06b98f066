"""Views whose pictures lie in a file, for scenes of more photos than memory holds."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from querysplat_cli.scene.files import atomic_path
from querysplat_cli.scene.views import Views


class FiledViews(Views):
    """Views that are read from their file each time they are asked for.

    `images` and `masks` are the whole, as a map of the file: only the parts that are looked at are in memory, for as
    long as the tensor lives. `picture` and the choice of some views read these alone.
    """

    _file: Path
    _canvas: tuple[int, int]

    def __init__(self, views: Views, file: Path) -> None:
        """Write `views` to `file`, picture by picture."""
        self.__dict__.update(
            names=views.names, sizes=views.sizes, _file=file, _canvas=tuple(views.masks.shape[1:])
        )  # the class is frozen
        with atomic_path(file) as draft, draft.open("wb") as opened:
            for row in range(len(views)):
                np.asarray(views.picture(row)).tofile(opened)
            for mask in views.masks:
                np.asarray(mask).tofile(opened)

    def __len__(self) -> int:
        return len(self.names)

    @property
    def images(self) -> Float[Tensor, "views 3 height width"]:
        """All pictures, from 0 to 1."""
        return self._mapped(np.float32, 0, (len(self), 3, *self._canvas))

    @property
    def masks(self) -> Bool[Tensor, "views height width"]:
        """All masks."""
        return self._mapped(np.bool_, self._masks_start, (len(self), *self._canvas))

    @property
    def _masks_start(self) -> int:
        """Bytes before the masks in the file."""
        return 4 * 3 * len(self) * int(np.prod(self._canvas))

    def picture(self, view: int) -> Float[Tensor, "3 height width"]:
        """One image in [0, 1]."""
        return self.images[view].clone()

    def __getitem__(self, index: Sequence[int]) -> Views:
        """Some of the views, in memory."""
        rows = torch.as_tensor(index, dtype=torch.long)
        names, sizes = tuple(self.names[row] for row in index), tuple(self.sizes[row] for row in index)
        return Views(self.images[rows], self.masks[rows], names, sizes)

    def hide(self, view: int, pixels: Bool[Tensor, "height width"]) -> None:
        """These pixels of a view take no part from now on; the file holds that."""
        shown = self.masks[view] & ~pixels
        with self._file.open("r+b") as opened:
            opened.seek(self._masks_start + view * shown.numel())
            np.asarray(shown).tofile(opened)

    def _mapped(self, kind: type, start: int, shape: tuple[int, ...]) -> Tensor:
        # Copy on write: torch warns of arrays that cannot be written.
        return torch.from_numpy(np.memmap(self._file, kind, "c", start, shape).view(np.ndarray))
