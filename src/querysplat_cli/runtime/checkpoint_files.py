"""Checkpoint files: reading named tensors without a second copy, and checking them against a model."""

from collections.abc import Mapping
from pathlib import Path
from pickle import UnpicklingError

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from querysplat_cli.runtime.errors import QuerySplatError

NAMED = 5
"""How many wrong tensors an error message names."""
AT_ONCE = 32
"""Tensors converted between two openings of a file. Opening it anew gives back the memory of pages already read."""


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Tensors by name, and the metadata (empty for a .pt file). A tensor is read from the file when it is first used.

    A .pt file is loaded with `weights_only`, so that it cannot run code. Raises QuerySplatError when the file is
    damaged or holds anything but tensors.
    """
    try:
        if path.suffix in {".pt", ".pth"}:
            tensors = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
            metadata: dict[str, str] = {}
        else:
            with safe_open(path, framework="pt") as file:
                tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 - not a mapping
                metadata = file.metadata() or {}
    except (SafetensorError, OSError, RuntimeError, EOFError, UnpicklingError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise QuerySplatError(
            f"{path} is not a readable checkpoint: {reason}", "Fetch or make the file again."
        ) from error
    if not isinstance(tensors, dict) or not all(isinstance(tensor, Tensor) for tensor in tensors.values()):
        raise QuerySplatError(f"{path} holds other things than named tensors", "Give a file of weights alone.")
    return tensors, metadata


def fill(
    model: nn.Module, path: Path, stored: Mapping[str, str], dtypes: Mapping[str, torch.dtype], device: torch.device
) -> None:
    """Give `model`, made on the meta device, the tensors of a file. `stored` maps our names to those in the file.

    Each tensor goes straight to `device` and to its type in `dtypes`. If all have their types already, they stay mapped
    to the file.
    """
    names = list(stored)
    tensors, _ = read_tensors(path)
    # A single tensor that stays mapped would keep every page of the file that was read.
    copy = any(tensors[stored[name]].dtype != dtypes[name] for name in names)
    for start in range(0, len(names), AT_ONCE):
        tensors, _ = read_tensors(path)
        some = {
            name: tensors[stored[name]].to(device, dtypes[name], copy=copy) for name in names[start : start + AT_ONCE]
        }
        model.load_state_dict(some, assign=True, strict=False)


def check_tensors(model: nn.Module, tensors: Mapping[str, Tensor], source: str) -> None:
    """Raise QuerySplatError, naming the first missing, unexpected and misshapen tensors, unless all fit `model`."""
    wanted = {name: tuple(tensor.shape) for name, tensor in model.state_dict().items()}
    faults = [
        ("missing", sorted(wanted.keys() - tensors.keys())),
        ("unexpected", sorted(tensors.keys() - wanted.keys())),
        (
            "of another shape",
            [
                f"{name} {tuple(tensors[name].shape)} instead of {shape}"
                for name, shape in wanted.items()
                if name in tensors and tuple(tensors[name].shape) != shape
            ],
        ),
    ]
    descriptions = [f"{len(names)} {what} ({_first(names)})" for what, names in faults if names]
    if descriptions:
        raise QuerySplatError(
            f"{source} does not fit the model: tensors {'; '.join(descriptions)}",
            "It belongs to another model, or is cut off.",
        )


def _first(names: list[str]) -> str:
    return ", ".join(names[:NAMED]) + (", …" if len(names) > NAMED else "")
