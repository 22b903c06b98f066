"""The site has every page once, and the list of licences every package. `.ci/run` builds the site itself."""

import re
import tomllib
from importlib.metadata import PackageNotFoundError, distribution, version
from pathlib import Path

import pytest

import licences
import querysplat_cli

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
ROWS = licences.earlier()


def test_every_page_is_in_the_navigation_once() -> None:
    navigation = (ROOT / "mkdocs.yml").read_text().partition("\nnav:\n")[2]
    listed = re.findall(r"([\w/-]+\.md)$", navigation, re.MULTILINE)
    assert sorted(listed) == sorted(str(path.relative_to(DOCS)) for path in DOCS.rglob("*.md"))


def test_marks_of_fences_are_hidden_from_the_site() -> None:
    """mkdocs takes a fence with two words for a paragraph."""
    hooks: dict[str, object] = {}
    exec((DOCS / "site" / "hooks.py").read_text(), hooks)
    page = "```python slow\n>>> 1\n```\n\n```toml entry-points\na = 1\n```\n\n```\nplain words\n```\n"
    clean = hooks["on_page_markdown"](page, page=None, config=None)  # type: ignore[operator]
    assert clean == "```python\n>>> 1\n```\n\n```toml\na = 1\n```\n\n```\nplain words\n```\n"


@pytest.mark.parametrize("name", sorted(licences.wanted()))
def test_every_dependency_is_listed_with_its_licence(name: str) -> None:
    """`python benchmarks/licences.py` writes the list."""
    row = ROWS[name]
    assert row.licence.strip()
    assert row.home.startswith("http")
    try:
        installed = distribution(name)
    except PackageNotFoundError:
        return
    if installed.version == row.version:
        assert licences.row(name, row.part) == row


def test_packages_of_an_extra_that_is_not_installed_keep_their_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    """What kornia needs is not known without kornia."""
    find = licences.find
    monkeypatch.setattr(licences, "find", lambda name: None if name.startswith("kornia") else find(name))
    before = {name: licences.Row(name, "1", "MIT", "https://", "matching") for name in ("kornia", "kornia-rs")}
    gone = licences.Row("no-longer-needed", "1", "MIT", "https://", "base")
    kept = licences.rows({**before, "no-longer-needed": gone})
    assert [row for row in kept if row.part == "matching"] == list(before.values())
    assert gone not in kept


def test_the_version_stands_in_one_place() -> None:
    """In pyproject.toml; the package asks its own metadata. An old installation of a checkout is not looked at."""
    stated = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert querysplat_cli.__version__ in (version("querysplat"), "0+unknown")
    sources = "".join(path.read_text() for path in (ROOT / "src").rglob("*.py"))
    assert f'"{stated}"' not in sources


@pytest.mark.parametrize("name", ["cpu", "cuda"])
def test_images_install_what_the_extras_are_called(name: str) -> None:
    """No Docker runs in the tests; what can be compared is compared."""
    text = (ROOT / "docker" / f"{name}.Dockerfile").read_text()
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    (asked,) = re.findall(r"'\.\[([\w,]+)\]'", text)
    assert set(asked.split(",")) <= extras.keys()
    pins = dict(
        line.split("==")
        for line in (ROOT / "constraints.txt").read_text().splitlines()
        if "==" in line and " " not in line
    )
    for pinned in re.findall(r"'torch==([\d.]+)", text):
        assert pinned == pins["torch"]
    assert 'ENTRYPOINT ["querysplat"]' in text
