"""Imports point down the layers only, and the command line starts without importing heavy packages."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import querysplat_cli

ROOT = Path(querysplat_cli.__file__).parent
LAYERS = (
    *("runtime", "scene", "splat", "encoders", "model", "queries", "prune", "tto"),
    *("reporting", "pipeline", "training", "evaluation", "commands", "cli"),
)
"""Every box, lowest first: each imports itself and the boxes in front of it in this list."""
ROOT_FILES = {"__init__", "__main__"}


def test_every_module_is_in_a_box() -> None:
    boxes = {path.name for path in ROOT.iterdir() if path.is_dir() and any(path.glob("*.py"))}
    assert boxes == set(LAYERS)
    assert {path.stem for path in ROOT.glob("*.py")} == ROOT_FILES


@pytest.mark.parametrize("path", sorted(ROOT.glob("*/**/*.py")), ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_point_down(path: Path) -> None:
    own = path.relative_to(ROOT).parts[0]
    for node in ast.walk(ast.parse(path.read_text())):
        names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
        names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        for name in names:
            if name.startswith("querysplat_cli."):
                other = name.split(".")[1]
                assert LAYERS.index(other) <= LAYERS.index(own), f"{own} imports {other}"


def test_help_imports_neither_torch_nor_pycolmap() -> None:
    code = """
import sys
from typer.main import get_command
from querysplat_cli.cli import run
from querysplat_cli.cli.app import app

verbs = [[], *([name] for name in get_command(app).commands)]
assert [run([*verb, "--help"]) for verb in verbs] == [0] * len(verbs)
assert run(["--version"]) == 0
heavy = {"torch", "pycolmap", "numba", "cv2", "scipy"} & set(sys.modules)
assert not heavy, heavy
"""
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
