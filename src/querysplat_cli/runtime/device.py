"""Where the network and the splatter run."""

import ctypes
import resource
import sys
from contextlib import suppress
from dataclasses import fields, is_dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeVar

import torch

from querysplat_cli.runtime.errors import MissingPart, QuerySplatError
from querysplat_cli.runtime.limits import free_memory
from querysplat_cli.runtime.optional_parts import install_command

Part = TypeVar("Part")


def find_device(name: str) -> torch.device:
    """The device called `auto`, `cpu` or `cuda`. auto is CUDA where a GPU and gsplat are there, and the CPU elsewhere.

    Raises QuerySplatError for another name, and MissingPart when `cuda` lacks something that it needs.
    """
    if name not in ("auto", "cpu", "cuda"):
        raise QuerySplatError(f"--device {name}: no such device", "Choose auto, cpu or cuda.")
    lacking = None
    if not torch.cuda.is_available():
        lacking = "this machine, or this build of torch, has no CUDA device"
    elif not find_spec("gsplat"):
        lacking = f"rendering on a GPU needs gsplat ({install_command('cuda')})"
    if name == "cuda" and lacking:
        raise MissingPart(f"--device cuda: {lacking}", "Use --device cpu.")
    return torch.device("cpu" if name == "cpu" or lacking else "cuda")


def free_bytes(device: torch.device) -> int:
    """Bytes of memory that a program can still take on `device`; of the machine's where that is the CPU."""
    return torch.cuda.mem_get_info(device)[0] if device.type == "cuda" else free_memory()


def tensor_bytes(part: Any) -> int:
    """The bytes of every tensor of `part`, which is as in `to_device`."""
    if isinstance(part, torch.Tensor):
        return part.nbytes
    if is_dataclass(part):
        part = tuple(getattr(part, field.name) for field in fields(part))
    return sum(tensor_bytes(item) for item in part) if isinstance(part, tuple) else 0


def peak_gib(device: torch.device | None = None) -> float:
    """The most memory, in GiB, that this process has held so far, or that torch has held on the GPU `device`."""
    if device and device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 2**30
    # psutil has no peak on Linux, and getrusage() cannot be reset as VmHWM can.
    with suppress(OSError, StopIteration):
        lines = Path("/proc/self/status").read_text().splitlines()
        return int(next(line.split()[1] for line in lines if line.startswith("VmHWM"))) / 2**20
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**30


def return_freed_memory() -> None:
    """Give memory that is free again back to the system.

    glibc keeps it for later blocks: 2.0 of 2.5 GiB after ten training samples of different sizes. With another C
    library nothing happens.
    """
    with suppress(OSError, AttributeError):
        ctypes.CDLL("libc.so.6").malloc_trim(0)


def reset_peak_memory() -> bool:
    """Start `peak_gib` of this process again at the memory that is held now.

    Returns False where the system cannot do that: anywhere but on Linux, and where /proc cannot be written.
    """
    try:
        Path("/proc/self/clear_refs").write_text("5")  # proc(5)
    except OSError:
        return False
    return True


def to_device(part: Part, device: torch.device) -> Part:
    """`part` with every tensor on `device`. It is a tensor, or a dataclass or tuple that holds tensors."""
    found: Any = part
    if isinstance(found, torch.Tensor):
        found = found.to(device)
    elif isinstance(found, tuple):
        found = tuple(to_device(item, device) for item in found)
    elif is_dataclass(found) and not isinstance(found, type):
        found = replace(found, **{field.name: to_device(getattr(found, field.name), device) for field in fields(found)})
    result: Part = found
    return result
