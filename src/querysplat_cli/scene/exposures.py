"""One affine colour transform for each photo, where exposure or white balance changed from photo to photo."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from querysplat_cli.runtime.errors import MAKE_AGAIN, QuerySplatError
from querysplat_cli.runtime.json_files import read_json
from querysplat_cli.scene.tensor_dataclass import TensorDataclass
from querysplat_cli.scene.views import Views

LARGEST = 1e3
"""The largest number in a transform that is read. Ten stops between photos are a factor of 1,024 in light, and far less
in sRGB.
"""


@dataclass(frozen=True)
class Exposures(TensorDataclass):
    """For each view a matrix (M | b): the photo shows M·c + b where the scene has the sRGB colour c in [0, 1].

    The mean of the matrices is the identity, so that the scene has the colours of the mean photo.
    """

    matrices: Float[Tensor, "views 3 4"]

    def __len__(self) -> int:
        return len(self.matrices)

    def __getitem__(self, rows: Sequence[int]) -> "Exposures":
        """Those of some views."""
        return Exposures(self.matrices[torch.as_tensor(rows, dtype=torch.long)])

    @classmethod
    def identity(cls, views: int) -> "Exposures":
        """Transforms that change nothing."""
        return cls(torch.eye(3, 4, dtype=torch.float64).repeat(views, 1, 1))

    def with_identity_mean(self) -> "Exposures":
        """The same differences between photos, for a scene of other colours.

        Every transform is preceded by the inverse of their mean. The mean of the results is the identity.
        """
        mean = self.matrices.mean(0)
        linear = self.matrices[:, :, :3] @ torch.linalg.inv(mean[:, :3])
        offset = self.matrices[:, :, 3:] - linear @ mean[:, 3:]
        return Exposures(torch.cat([linear, offset], 2))

    def removed_from(self, views: Views) -> Views:
        """The views in the colours of the scene, clipped to [0, 1], with as many bits as they have."""
        images = torch.empty_like(views.images)
        for view, matrix in enumerate(self.matrices):
            picture = views.picture(view)
            back, offset = torch.linalg.inv(matrix[:, :3]).to(picture), matrix[:, 3, None, None].to(picture)
            picture = torch.einsum("ij,jhw->ihw", back, picture - offset).clamp(0, 1) * views.masks[view]
            images[view] = (picture * 255).round() if images.dtype == torch.uint8 else picture
        return replace(views, images=images)


def write_exposures(path: Path, names: Sequence[str], exposures: Exposures) -> None:
    """Write the matrices, row by row, with the names of their photos."""
    rows = zip(names, exposures.matrices.tolist(), strict=True)
    entries = [{"name": name, "matrix": matrix} for name, matrix in rows]
    path.write_text(json.dumps({"photos": entries}, indent=1) + "\n")


def read_exposures(path: Path, names: Sequence[str]) -> Exposures | None:
    """The transforms of the photos `names`; None where there is no such file.

    Raises QuerySplatError when it is damaged.
    """
    if not path.is_file():
        return None
    try:
        found = {entry["name"]: entry["matrix"] for entry in read_json(path, MAKE_AGAIN)["photos"]}
        matrices = torch.tensor([found[name] for name in names], dtype=torch.float64)
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise QuerySplatError(
            f"{path} is damaged: it must hold a name and a matrix for each photo", MAKE_AGAIN
        ) from error
    if matrices.shape[1:] != (3, 4) or not bool(matrices.isfinite().all()):
        raise QuerySplatError(f"{path} is damaged: it must hold 3 × 4 finite numbers for each photo", MAKE_AGAIN)
    if bool((matrices.abs() > LARGEST).any()):
        raise QuerySplatError(f"{path} is damaged: it holds a transform that is no exposure's", MAKE_AGAIN)
    if bool((torch.linalg.det(matrices[:, :, :3]).abs() < 1e-6).any()):
        raise QuerySplatError(f"{path} is damaged: it holds a transform that cannot be inverted", MAKE_AGAIN)
    return Exposures(matrices)
