"""Parts by name: our own, those that a program registers, and entry points of other packages."""

import math
from pathlib import Path

import pytest

from querysplat_cli.runtime.errors import ExitCode, MissingPart, QuerySplatError
from querysplat_cli.runtime.registry import Registry


def made() -> Registry:
    return Registry("test part", "querysplat.tests", {"root": "math:sqrt"})


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package that is installed outside of this repository, with three entry points, one of them broken."""
    facts = tmp_path / "their_parts-2.0.dist-info"
    facts.mkdir()
    (facts / "METADATA").write_text("Metadata-Version: 2.1\nName: their-parts\nVersion: 2.0\n")
    (facts / "entry_points.txt").write_text(
        "[querysplat.tests]\ndouble = their_parts:double\nbroken = their_parts_broken:any\nroot = their_parts:double\n"
    )
    (tmp_path / "their_parts.py").write_text("def double(x):\n    return 2 * x\n")
    (tmp_path / "their_parts_broken.py").write_text("raise RuntimeError('no such GPU')\n")
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path


def test_our_own_are_imported_by_their_place() -> None:
    assert made().find("root") is math.sqrt
    assert made().names() == ("root",)


def test_a_program_registers_one_for_this_process() -> None:
    registry = made()
    registry.register("cube", lambda x: x**3)
    assert registry.names() == ("root", "cube")
    assert registry.find("cube")(2) == 8
    registry.register("cube", lambda x: -x)
    assert registry.find("cube")(2) == -2
    with pytest.raises(QuerySplatError, match="cube"):
        made().find("cube")


@pytest.mark.parametrize("name", ["root", "auto", "", "two words", "../up", "1st"])
def test_names_that_are_taken_or_no_words_are_refused(name: str) -> None:
    registry = made()
    with pytest.raises(QuerySplatError, match="can be registered"):
        registry.register(name, print)
    assert registry.names() == ("root",)


def test_other_packages_bring_theirs(installed: Path) -> None:
    registry = made()
    assert registry.names() == ("root", "broken", "double")
    assert registry.find("double")(21) == 42
    assert registry.find("root") is math.sqrt, "our own names cannot be taken"


def test_a_package_that_does_not_load_is_named(installed: Path) -> None:
    with pytest.raises(MissingPart, match=r"'broken' of the package their-parts .*no such GPU") as error:
        made().find("broken")
    assert error.value.code == ExitCode.MISSING_PART


def test_an_unknown_name_is_answered_with_those_there_are(installed: Path) -> None:
    with pytest.raises(QuerySplatError, match="no test part named 'nothing'") as error:
        made().find("nothing")
    assert error.value.hint == "Choose one of: root, broken, double."
