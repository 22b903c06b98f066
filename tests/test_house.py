"""Files, functions and signatures stay short; every lower bound is one that was tested."""

import ast
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

import querysplat_cli

ROOT = Path(querysplat_cli.__file__).parent
FILES = {str(path.relative_to(ROOT)): path for path in sorted(ROOT.glob("**/*.py"))}

REPOSITORY = Path(__file__).parents[1]

MOST_FILE_LINES = 300
MOST_FUNCTION_LINES = 60
MOST_ARGUMENTS = 7

Function = ast.FunctionDef | ast.AsyncFunctionDef


def functions(tree: ast.AST, inside: str = "") -> Iterator[tuple[str, Function]]:
    """Every function of a file with its dotted name, those within classes and functions too."""
    for node in ast.iter_child_nodes(tree):
        name = inside
        if isinstance(node, Function | ast.ClassDef):
            name = f"{inside}.{node.name}".lstrip(".")
        if isinstance(node, Function):
            yield name, node
        yield from functions(node, name)


def public_functions(tree: ast.AST, inside: str = "") -> Iterator[tuple[str, Function]]:
    """The functions and methods that another module may call: no underscore, not within another function."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, Function):
            if not node.name.startswith("_") or node.name == "__init__":
                yield f"{inside}{node.name}", node
        elif isinstance(node, ast.ClassDef):
            if not node.name.startswith("_"):
                yield from public_functions(node, f"{inside}{node.name}.")
        else:
            yield from public_functions(node, inside)


def is_compiled(function: Function) -> bool:
    return any("njit" in ast.unparse(decorator) for decorator in function.decorator_list)


def argument_count(function: Function, *, is_method: bool) -> int:
    """The arguments that a caller gives, so without `self` and `cls`."""
    every = function.args
    named = [*every.posonlyargs, *every.args, *every.kwonlyargs]
    is_static = any(ast.unparse(decorator) == "staticmethod" for decorator in function.decorator_list)
    return len(named) - (is_method and not is_static) + (every.vararg is not None) + (every.kwarg is not None)


def line_count(node: Function) -> int:
    assert node.end_lineno is not None
    return node.end_lineno - node.lineno + 1


def test_files_are_short() -> None:
    files = [*FILES.values(), *(path for box in ("tests", "benchmarks") for path in (REPOSITORY / box).rglob("*.py"))]
    lines = {str(path): len(path.read_text().splitlines()) for path in files}
    assert {path: count for path, count in lines.items() if count > MOST_FILE_LINES} == {}


@pytest.mark.parametrize("name", FILES)
def test_functions_are_short(name: str) -> None:
    found = functions(ast.parse(FILES[name].read_text()))
    long = {where: line_count(node) for where, node in found if not is_compiled(node)}
    assert not {where: lines for where, lines in long.items() if lines > MOST_FUNCTION_LINES}


@pytest.mark.parametrize("name", FILES)
def test_public_functions_take_few_arguments(name: str) -> None:
    """Compiled kernels take arrays, not objects. Dataclasses pass by themselves: their `__init__` stands in no file."""
    found = public_functions(ast.parse(FILES[name].read_text()))
    counts = {where: argument_count(node, is_method="." in where) for where, node in found if not is_compiled(node)}
    assert not {where: count for where, count in counts.items() if count > MOST_ARGUMENTS}


EXAMPLE = """
class Public:
    def __init__(self, a): ...
    @staticmethod
    def static(a, *b, c, **d):
        def inner(): ...
    def _own(self): ...
class _Private:
    def method(self): ...
if True:
    @nb.njit(cache=True)
    def compiled(a):
        return a
"""


def test_the_example_is_counted_right() -> None:
    tree = ast.parse(EXAMPLE)
    every = dict(functions(tree))
    names = ["Public.__init__", "Public.static", "Public.static.inner", "Public._own", "_Private.method", "compiled"]
    assert list(every) == names
    counts = {name: argument_count(node, is_method="." in name) for name, node in public_functions(tree)}
    assert counts == {"Public.__init__": 1, "Public.static": 4, "compiled": 1}
    assert [name for name, node in every.items() if is_compiled(node)] == ["compiled"]
    assert line_count(every["Public.static"]) == 2


def test_lower_bounds_are_the_lowest_tested_versions() -> None:
    """A bound is what its pin in constraints-lowest.txt begins with: `numpy>=2.0` for `numpy==2.0.0`."""
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    wanted = [*project["dependencies"], *extras["test"], *extras["formats"], *extras["mesh"], *extras["metrics"]]
    wanted = [line for line in wanted if not line.startswith("querysplat")]
    found = [re.fullmatch(r"([\w-]+)(?:\[.*\])?>=([\d.]+)", line) for line in wanted]
    bounds = {match[1]: match[2] for match in found if match}
    assert len(bounds) == len(found), "every dependency has a lower bound and nothing else"
    lines = (REPOSITORY / "constraints-lowest.txt").read_text().splitlines()
    pins = dict(line.split("==") for line in lines if not line.startswith("#"))
    assert bounds.keys() == pins.keys()
    assert not {name: pins[name] for name, bound in bounds.items() if not f"{pins[name]}.".startswith(f"{bound}.")}


def test_test_files_have_names_of_their_own() -> None:
    """pytest imports them by their bare names."""
    names = [path.name for path in (REPOSITORY / "tests").rglob("test_*.py")]
    assert sorted(names) == sorted(set(names))
