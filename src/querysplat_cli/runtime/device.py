"""Where the network and the splatter run."""

import resource
import sys
from contextlib import suppress
from dataclasses import fields, is_dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeVar

import torch

from querysplat_cli.runtime.errors import MissingPart, QuerySplatError

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


def peak_gib(device: torch.device | None = None) -> float:
    """The most memory that this process has held so far, or that torch has on the GPU `device`."""
    if device and device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 2**30
    with suppress(OSError, StopIteration):
        lines = Path("/proc/self/status").read_text().splitlines()
        return int(next(line.split()[1] for line in lines if line.startswith("VmHWM"))) / 2**20
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**30


def reset_peak_memory() -> bool:
    """Have `peak_gib` of this process start again at what is held now; False where the system cannot, which is
    anywhere but Linux, and in containers whose /proc cannot be written."""
    try:
        Path("/proc/self/clear_refs").write_text("5")  # proc(5)
    except OSError:
        return False
    return True


def to_device(part: Part, device: torch.device) -> Part:
    """`part`, a tensor or a dataclass or tuple that holds tensors, with every tensor on `device`."""
    found: Any = part
    if isinstance(found, torch.Tensor):
        found = found.to(device)
    elif isinstance(found, tuple):
        found = tuple(to_device(item, device) for item in found)
    elif is_dataclass(found) and not isinstance(found, type):
        found = replace(found, **{field.name: to_device(getattr(found, field.name), device) for field in fields(found)})
    moved_part: Part = found
    return moved_part
