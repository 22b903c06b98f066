"""Imports point down the flow only, and the command line starts without the heavy packages."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import querysplat_cli

ROOT = Path(querysplat_cli.__file__).parent
MODULES = sorted(ROOT.rglob("*.py"))
LAYERS = [
    {"errors", "progress", "device", "precision", "tensor_files", "catalogue", "drawing"},
    {"scene"},
    {"model", "encoders", "splat"},
    {"prune"},
    {"holdout", "feedback"},
    {"tto", "training"},
    {"quality", "report", "preview", "curve", "store", "memory", "weight_files", "remembering"}
    | {"savings", "budget", "pipeline", "rendering", "inspection", "demo", "convert"},
    {"evaluation"},
    {"cli", "__main__"},
]


def layer(part: str) -> int:
    return next(i for i, parts in enumerate(LAYERS) if part in parts)


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_point_down(path: Path) -> None:
    own = path.relative_to(ROOT).with_suffix("").parts[0]
    if own == "__init__":
        return
    for node in ast.walk(ast.parse(path.read_text())):
        names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
        names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        for name in names:
            if name.startswith("querysplat_cli."):
                other = name.split(".")[1]
                assert other == own or layer(other) <= layer(own), f"{own} imports {other}"
                siblings = {"model", "encoders", "splat"}
                assert not (own in siblings and other in siblings - {own}), f"{own} imports its sibling {other}"


def test_help_imports_neither_torch_nor_pycolmap() -> None:
    code = (
        "import sys; from querysplat_cli.cli import run; run(['--help']);"
        "heavy = {'torch', 'pycolmap', 'numba', 'cv2', 'scipy'} & set(sys.modules); assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
