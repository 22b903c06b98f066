"""What follows a kill: the sweep of the next run, and a look at every file."""

import json
from pathlib import Path

from querysplat_cli.pipeline.gaussian_files import read_gaussians
from querysplat_cli.pipeline.read_scene import read_scene
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.drafts import SCRATCH, sweep
from querysplat_cli.scene.files import check_writable
from querysplat_cli.scene.formats.streamed_index import INDEX_NAME
from querysplat_cli.scene.formats.streamed_sog import read_levels

import av
import numpy as np
from PIL import Image
from safetensors import SafetensorError
from safetensors.torch import load_file


def next_run(work: Path, temporary: Path) -> None:
    """What the next run does before its work: sweep what a kill left, here and among the temporary files."""
    for folder in (work, *(path for path in work.iterdir() if path.is_dir())):
        check_writable(folder)
    sweep(temporary, SCRATCH)


def half_written(work: Path) -> list[str]:
    """Faults of the files after a kill: each is the old one or the new one, and whole."""
    faults = []
    for path in sorted(path for path in work.rglob("*") if path.is_file()):
        try:
            _read(path)
            if path.suffix == ".ply" and path.with_suffix("").is_dir():
                read_scene(path)
        except (QuerySplatError, ValueError, OSError, SafetensorError) as error:
            faults.append(f"half-written: {path.relative_to(work)}: {error}")
    return faults


def _read(path: Path) -> None:
    """Read the whole file. Raises an error of the library or of the package where it is not whole."""
    if path.suffix in (".ply", ".spz"):
        read_gaussians(path)
    elif path.suffix == ".safetensors":
        load_file(path)
    elif path.name == INDEX_NAME:
        list(read_levels(path))
    elif path.suffix == ".json":
        json.loads(path.read_text())
    elif path.suffix == ".jsonl":
        [json.loads(line) for line in path.read_text().splitlines()]
    elif path.suffix == ".npz":
        dict(np.load(path))
    elif path.suffix == ".mp4":
        with av.open(str(path)) as film:
            list(film.decode(video=0))
    elif path.suffix == ".png":
        with Image.open(path) as picture:
            picture.load()
    elif path.suffix == ".html" and not path.read_text().rstrip().endswith("</html>"):
        raise ValueError("it has no end")
