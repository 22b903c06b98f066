"""Where the network and the splatter run."""

from dataclasses import fields, is_dataclass, replace
from importlib.util import find_spec
from typing import Any, TypeVar

import torch

from querysplat_cli.errors import MissingPart, QuerySplatError

Part = TypeVar("Part")


def find_device(name: str) -> torch.device:
    """The device called `auto`, `cpu` or `cuda`; auto is CUDA where a GPU and gsplat are there.

    Raises MissingPart when CUDA is asked for and something that it needs is not there.
    """
    if name not in ("auto", "cpu", "cuda"):
        raise QuerySplatError(f"--device {name}: no such device", "Choose auto, cpu or cuda.")
    lacking = None
    if not torch.cuda.is_available():
        lacking = "this machine, or this build of torch, has no CUDA device"
    elif not find_spec("gsplat"):
        lacking = "rendering on a GPU needs gsplat (pip install 'querysplat[cuda]')"
    if name == "cuda" and lacking:
        raise MissingPart(f"--device cuda: {lacking}", "Use --device cpu.")
    return torch.device("cpu" if name == "cpu" or lacking else "cuda")


def moved(part: Part, device: torch.device) -> Part:
    """`part`, a tensor or a dataclass or tuple that holds tensors, with every tensor on `device`."""
    found: Any = part
    if isinstance(found, torch.Tensor):
        found = found.to(device)
    elif isinstance(found, tuple):
        found = tuple(moved(item, device) for item in found)
    elif is_dataclass(found) and not isinstance(found, type):
        found = replace(found, **{field.name: moved(getattr(found, field.name), device) for field in fields(found)})
    moved_part: Part = found
    return moved_part
