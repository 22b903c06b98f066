"""The weight files that are not part of the package: their origin, contents, licence, and place on this machine."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from querysplat_cli.runtime.errors import MissingPart
from querysplat_cli.runtime.optional_parts import install_command

NON_COMMERCIAL = "FAIR Noncommercial Research License: no commercial use, of what is made with it either"


@dataclass(frozen=True)
class WeightFile:
    """A file on the Hugging Face Hub.

    `tensors` and `values` count the tensors that are read, and the numbers in them. `sha256` is None where none is
    published.
    """

    file: str
    repository: str
    licence: str
    gated: bool
    tensors: int
    values: int
    sha256: str | None = None

    @property
    def gib(self) -> float:
        """Size of the tensors that are read, in GiB, as float32."""
        return self.values * 4 / 2**30


WEIGHTS = {
    "official-8192": WeightFile(
        "querysplat_vggto_1B_512_8192.safetensors", "inspatio/querysplat", "Apache-2.0", False, 521, 1_117_923_780
    ),
    "official-paper": WeightFile(
        "querysplat_vggto_1B_512_paper.safetensors", "inspatio/querysplat", "Apache-2.0", False, 521, 1_116_743_556
    ),
    "vggt_omega": WeightFile(
        "vggt_omega_1b_512.pt",
        "facebook/VGGT-Omega",
        NON_COMMERCIAL,
        True,
        1411,
        1_144_059_977,
        "c02da418b18bb01d0392598d3f6147366bcde1bb70fd08a5e3bf7925b0667934",
    ),
    "vggt": WeightFile(
        "model.safetensors",
        "facebook/VGGT-1B",
        "CC BY-NC 4.0 (facebook/VGGT-1B-Commercial has another)",
        False,
        1341,
        1_157_941_492,
    ),
}
"""The files by the name of the preset or encoder that reads them."""


def find_weights(part: str, folder: Path | None) -> Path:
    """The file of `part` (a key of WEIGHTS) in `folder`, or in the Hugging Face cache when `folder` is None.

    In a folder the file may end in .safetensors, .pt or .pth. Raises MissingPart when there is no such file.
    """
    wanted = WEIGHTS[part]
    if folder is not None:
        for suffix in (Path(wanted.file).suffix, ".safetensors", ".pt", ".pth"):
            path = (folder / wanted.file).with_suffix(suffix)
            if path.is_file():
                return path
        raise MissingPart(f"{folder} does not hold the weights {wanted.file}", _where_from(wanted))
    cached = _cached(wanted)
    if cached is None:
        raise MissingPart(f"the weights {wanted.file} are not in the Hugging Face cache", _where_from(wanted))
    return cached


def sha256(path: Path, progress: Callable[[float], None] = lambda fraction: None) -> str:
    """The SHA-256 of a file, in hexadecimal. `progress` is called with the fraction that is read."""
    digest, size, read = hashlib.sha256(), path.stat().st_size, 0
    with path.open("rb") as file:
        while block := file.read(1 << 24):
            digest.update(block)
            read += len(block)
            progress(read / size)
    return digest.hexdigest()


def _cached(wanted: WeightFile) -> Path | None:
    try:
        from huggingface_hub import try_to_load_from_cache
    except ImportError as error:
        raise MissingPart(
            f"the weights {wanted.file} are not given, and looking in the Hugging Face cache needs huggingface_hub",
            f"Run `{install_command('weights')}`, or give their folder: --weights DIR (train: --set data.weights=DIR).",
        ) from error
    found = try_to_load_from_cache(wanted.repository, wanted.file)
    return Path(found) if isinstance(found, str) else None


def _where_from(wanted: WeightFile) -> str:
    gate = "after asking for access there, " if wanted.gated else ""
    return f"{gate}`hf download {wanted.repository} {wanted.file}`; `querysplat weights` has licences and sizes."
