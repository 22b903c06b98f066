"""Benchmarks import the package before torch, so that OpenMP's threads sleep beside other programs."""

import subprocess
import sys
from pathlib import Path

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
FIRST_OF_EACH = """
import sys
from importlib import import_module

class Reached(Exception):
    pass

class Stop:
    def find_spec(self, name, path=None, target=None):
        if name in ("torch", "pycolmap", "numba"):
            raise Reached(name)

sys.meta_path.insert(0, Stop())
before = set(sys.modules)
for program in sys.argv[1:]:
    try:
        import_module(program)
    except Reached as library:
        if "querysplat_cli" not in sys.modules:
            print(program, "imports", library, "first")
    for name in set(sys.modules) - before:
        if name.split(".")[0] in ("querysplat_cli", "common", *sys.argv[1:]):
            del sys.modules[name]
"""


def test_the_package_comes_before_libraries_with_threads() -> None:
    """Torch came first, and three photos beside four busy programs took 10.6 s of the processor instead of 4.2."""
    programs = sorted(path.stem for path in BENCHMARKS.glob("*.py"))
    done = subprocess.run(
        [sys.executable, "-c", FIRST_OF_EACH, *programs], cwd=BENCHMARKS, capture_output=True, text=True
    )
    assert (done.stdout, done.stderr, done.returncode) == ("", "", 0)
