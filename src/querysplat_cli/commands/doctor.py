"""What `doctor` finds out: this installation, this machine, what is compiled, and what is optional."""

import os
import platform
import shutil
import tempfile
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path

import psutil

import querysplat_cli
from querysplat_cli.reporting.report import machine
from querysplat_cli.runtime import signals
from querysplat_cli.runtime.caches import is_cached
from querysplat_cli.runtime.colmap import load_pycolmap
from querysplat_cli.runtime.compiler import DEPTH_KERNELS, SCENE_KERNELS, kernels
from querysplat_cli.runtime.limits import GIB, free_memory
from querysplat_cli.runtime.optional_parts import OPTIONAL_PARTS, OptionalPart

COMPILED_MODULES = ("torch", "numba", "cv2", "pycolmap", "scipy", "av")
"""Required packages with native code, which can be installed and yet not load."""
TESTED_PYTHON = ("3.11", "3.13")
"""The first and the last version of Python that the tests ran with."""
LEAST_MEMORY = 1.5
"""GiB that seven to twenty photos take (docs/quickstart.md)."""
LEAST_DISK = 0.5
"""GiB for drafts of a scene and their photos."""


@dataclass(frozen=True)
class Optional:
    """An optional part: its installed version (None: not here), what it gives, and the command that installs it."""

    extra: str
    version: str | None
    gives: str
    command: str


@dataclass(frozen=True)
class Diagnosis:
    """What was found. Memory and disk are in GiB; `compiled` counts kernels, of `kernels`.

    `cuda` is the name of the GPU, or why there is none. `encoders` and `splatters` are the names of all that are
    installed, those of other packages too. Each of `problems` is a sentence that says what to do.
    """

    querysplat: str
    package: str
    machine: str
    memory_gib: float
    free_memory_gib: float
    free_disk_gib: float
    temporary: str
    kernels: int
    compiled: int
    cuda: str
    devices: tuple[str, ...]
    encoders: tuple[str, ...]
    splatters: tuple[str, ...]
    optional: tuple[Optional, ...]
    problems: tuple[str, ...]


def diagnose() -> Diagnosis:
    """Look at everything. Nothing is written, compiled or fetched."""
    broken = _broken_modules()
    kernels, compiled = (0, 0) if broken else _kernels()
    encoders, splatters = ((), ()) if broken else _backends()
    devices, cuda = (("cpu",), "torch cannot be loaded") if "torch" in broken else _devices()
    free = free_memory() / GIB
    temporary, disk = _temporary()
    return Diagnosis(
        querysplat=querysplat_cli.__version__,
        package=str(Path(querysplat_cli.__file__).parent),
        machine=machine(),
        memory_gib=round(psutil.virtual_memory().total / GIB, 1),
        free_memory_gib=round(free, 1),
        free_disk_gib=round(disk, 1),
        temporary=temporary,
        kernels=kernels,
        compiled=compiled,
        cuda=cuda,
        devices=devices,
        encoders=encoders,
        splatters=splatters,
        optional=tuple(_optional(part) for part in OPTIONAL_PARTS),
        problems=(*(f"{name} cannot be loaded: {why}" for name, why in broken.items()), *_problems(free, disk)),
    )


def _broken_modules() -> dict[str, str]:
    """Each required native module that does not load, and the error in one line."""
    broken = {}
    for name in COMPILED_MODULES:
        try:
            load_pycolmap() if name == "pycolmap" else import_module(name)
        except Exception as error:  # a missing system library raises OSError, a wrong build anything
            if signals.caught():
                raise KeyboardInterrupt from error
            first = str(error).partition("\n")[0]
            broken[name] = f"{first}. Run `pip install --force-reinstall --no-deps {_package(name)}`."
    return broken


def _package(module: str) -> str:
    return {"cv2": "opencv-contrib-python-headless"}.get(module, module)


def _kernels() -> tuple[int, int]:
    """The kernels that are compiled ahead, and how many of them numba's cache has."""
    cached = [is_cached(function) for module in (*DEPTH_KERNELS, *SCENE_KERNELS) for function, _ in kernels(module)]
    return len(cached), sum(cached)


def _backends() -> tuple[tuple[str, ...], tuple[str, ...]]:
    from querysplat_cli.encoders.registry import ENCODERS
    from querysplat_cli.splat.render import BACKENDS

    return ENCODERS.names(), BACKENDS.names()


def _devices() -> tuple[tuple[str, ...], str]:
    import torch

    if not torch.cuda.is_available():
        built = "this build of torch is for the CPU" if not torch.version.cuda else "no GPU or no driver"
        return ("cpu",), built
    name = torch.cuda.get_device_name()
    if not find_spec("gsplat"):
        return ("cpu",), f"{name}, but gsplat is not installed"
    return ("cpu", "cuda"), name


def _temporary() -> tuple[str, float]:
    """The folder of temporary files and its free GiB, 0 where nothing can be written."""
    try:
        folder = tempfile.gettempdir()
        return folder, shutil.disk_usage(folder).free / GIB
    except OSError:
        return "", 0.0


def _optional(part: OptionalPart) -> Optional:
    try:
        found = version(part.package) if find_spec(part.module) else None
    except PackageNotFoundError:
        found = "of unknown version"
    return Optional(part.extra, found, part.gives, part.command)


def _problems(free_memory_gib: float, free_disk_gib: float) -> list[str]:
    problems = []
    if free_memory_gib < LEAST_MEMORY:
        problems.append(
            f"{free_memory_gib:.1f} GiB of memory are free, and twenty photos take {LEAST_MEMORY}. "
            "Close other programs, or use --max-views and --max-size."
        )
    if free_disk_gib < LEAST_DISK:
        problems.append(f"{free_disk_gib:.1f} GiB are free for temporary files. Let TMPDIR name another folder.")
    if not os.access(Path.cwd(), os.W_OK):
        problems.append("The current folder cannot be written. Give another place with -o.")
    return problems


def tested_python() -> bool:
    """Whether the tests ran with this version of Python."""
    first, last = (tuple(map(int, text.split("."))) for text in TESTED_PYTHON)
    return first <= tuple(map(int, platform.python_version_tuple()[:2])) <= last
