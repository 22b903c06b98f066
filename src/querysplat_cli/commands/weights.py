"""What `weights` does: compare the registry of weight files with the files that are here."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from querysplat_cli.encoders.base import EncoderOptions
from querysplat_cli.encoders.registry import find_encoder
from querysplat_cli.model.checkpoints import load
from querysplat_cli.model.config import preset_names
from querysplat_cli.runtime.errors import MissingPart, QuerySplatError
from querysplat_cli.runtime.matching_weights import (
    FILES_OF,
    INSTALL,
    MATCHING_WEIGHTS,
    WheelFile,
    find_matching_weights,
)
from querysplat_cli.runtime.progress import Stages
from querysplat_cli.runtime.weight_registry import WEIGHTS, WeightFile, find_weights, sha256

NEEDED_BY = {
    "official-8192": "--preset official-8192",
    "official-paper": "--preset official-paper",
    "vggt_omega": "both official presets",
    "vggt": "--encoder vggt",
    **{part: f"--matcher {matcher}" for matcher, parts in FILES_OF.items() for part in parts},
}


@dataclass(frozen=True)
class Found:
    """A file of one of the registries, and where it is. `sha256` is None unless the file was read.

    `absent` is the reason why there is no file, and `fault` the reason why the file cannot be used.
    """

    wanted: WeightFile | WheelFile
    needed_by: str
    path: Path | None
    absent: str = ""
    sha256: str | None = None
    fault: str = ""

    def as_dict(self) -> dict[str, Any]:
        entry = asdict(self.wanted)
        if isinstance(self.wanted, WeightFile):
            entry |= {"gib": round(self.wanted.gib, 2), "expected_sha256": self.wanted.sha256}
        else:
            entry |= {"expected_sha256": self.wanted.sha256, "command": INSTALL}
        rest = {"needed_by": self.needed_by, "sha256": self.sha256, "absent": self.absent, "fault": self.fault}
        return entry | rest | {"path": self.path and str(self.path)}


def survey(folder: Path | None, *, verify: bool, stages: Stages) -> list[Found]:
    """Every file of the registries. With `verify`, the files that are here are read whole."""
    return [_look(part, folder, verify=verify, stages=stages) for part in (*WEIGHTS, *MATCHING_WEIGHTS)]


def _look(part: str, folder: Path | None, *, verify: bool, stages: Stages) -> Found:
    of_matcher, needed_by = part in MATCHING_WEIGHTS, NEEDED_BY[part]
    wanted = MATCHING_WEIGHTS[part] if of_matcher else WEIGHTS[part]
    try:
        path = find_matching_weights(part, folder) if of_matcher else find_weights(part, folder)
    except MissingPart as missing:
        return Found(wanted, needed_by, None, missing.message)
    if not verify:
        return Found(wanted, needed_by, path)
    with stages(wanted.file) as progress:
        digest = sha256(path, lambda fraction: progress("sha256", fraction))
        fault = _fault(part, folder, path, digest)
    return Found(wanted, needed_by, path, sha256=digest, fault=fault)


def _fault(part: str, folder: Path | None, path: Path, digest: str) -> str:
    """Why the file at `path`, which has this sha256, cannot be used, or ""."""
    if part in MATCHING_WEIGHTS:
        expected = MATCHING_WEIGHTS[part].sha256
        return "" if digest == expected else f"its sha256 should be {expected}"
    try:
        _load(part, folder)
    except QuerySplatError as error:
        return error.message
    wanted = WEIGHTS[part]
    # In the Hugging Face cache a file's name is the sha256 that the Hub has of it.
    expected = wanted.sha256 or (path.resolve().name if path.is_symlink() else digest)
    same = path.suffix != Path(wanted.file).suffix or expected == digest or len(expected) != len(digest)
    return "" if same else f"its sha256 should be {expected}"


def _load(part: str, folder: Path | None) -> None:
    """Load as `reconstruct` does, every tensor checked. The file is mapped, which takes little memory."""
    if part in preset_names():
        load(part, folder)
    else:
        find_encoder(part, EncoderOptions(weights=folder))
