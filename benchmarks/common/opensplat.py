"""OpenSplat's CPU build as a peer: trained on the input photos and with the cameras of a scene of ours, and timed.

The program is no part of this package, and is found on the path. It gets a COLMAP project that `querysplat convert`
writes, without the held-out photos.
"""

import shutil
import subprocess
import sys
import time
from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from common.command import children_cpu_seconds
from querysplat_cli.cli import run
from querysplat_cli.runtime.colmap import load_pycolmap
from querysplat_cli.scene.photo_files import PhotoFile

import psutil

PROGRAM = "opensplat"
STEPS = 2000
ROW = f"OpenSplat, {STEPS} steps"
"""Its name beside our settings."""
SAMPLED = 0.2
"""Seconds between two looks at its memory."""


@dataclass(frozen=True)
class Trained:
    """What the process took: seconds by the clock, those of all cores together, and the most resident memory in GiB.

    The memory is that of the process alone, as it was seen every `SAMPLED` seconds.
    """

    seconds: float
    cpu_seconds: float
    gib: float


def is_there() -> bool:
    """Whether the program is on the path."""
    return shutil.which(PROGRAM) is not None


def train(scene: Path, inputs: Sequence[PhotoFile], ply: Path) -> Trained | None:
    """Write `ply`, in the frame of the .ply of the scene with this folder; `inputs` are the photos it was made of.

    None, and a line on standard error, where the program fails or its project cannot be made.
    """
    with TemporaryDirectory() as scratch:
        project = Path(scratch) / "project"
        if not _write_project(project, scene, inputs):
            return None
        log = Path(scratch) / "log.txt"
        written = Path(scratch) / "peer.ply"  # it writes a cameras.json beside it
        code, took = _timed([PROGRAM, str(project), "--cpu", "--keep-crs", "-n", str(STEPS), "-o", str(written)], log)
        if code or not written.is_file():
            said = log.read_text(errors="replace").strip().splitlines() or ["no message"]
            print(f"opensplat ended with code {code}: {said[-1]}", file=sys.stderr)
            return None
        shutil.move(written, ply)
    return took


def _write_project(project: Path, scene: Path, inputs: Sequence[PhotoFile]) -> bool:
    """Whether `project` has become a COLMAP project of the input photos, and of no other ones."""
    model = project / "sparse" / "0"
    if run(["convert", str(scene), str(model), "--quiet"]):
        return False
    names = {file.name for file in inputs}
    lost = sorted(names - keep_images(model, names))
    if lost:
        print(f"{scene}: the COLMAP model has no {lost[0]}", file=sys.stderr)
        return False
    for file in inputs:
        link = project / "images" / file.name
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to(file.path)
    return True


def keep_images(model: Path, names: Collection[str]) -> set[str]:
    """Take all images with other names out of the COLMAP model in the folder `model`; the names that are left."""
    reconstruction = load_pycolmap().Reconstruction(model)
    images = list(reconstruction.images.values())
    for image in images:
        if image.name not in names:
            reconstruction.deregister_frame(image.frame_id)
    reconstruction.write(model)
    return {image.name for image in images} & set(names)


def _timed(command: Sequence[str], log: Path) -> tuple[int, Trained]:
    """The exit code of a command, whose output goes into `log`, and what it took."""
    before, start, most = children_cpu_seconds(), time.perf_counter(), 0
    with log.open("w") as output, subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT) as process:
        while process.poll() is None:
            with suppress(psutil.Error):
                most = max(most, psutil.Process(process.pid).memory_info().rss)
            with suppress(subprocess.TimeoutExpired):
                process.wait(SAMPLED)
    took = Trained(time.perf_counter() - start, children_cpu_seconds() - before, most / 2**30)
    return process.returncode, took
