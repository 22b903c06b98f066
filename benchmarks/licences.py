"""Write docs/licences.md: every package that an installation brings, its version, licence and home.

    extras=heic,formats,mesh,cuda,weights,matching,tensorboard,cluster,metrics
    pip install -c constraints.txt ".[$extras]" && python benchmarks/licences.py

The facts are those of the installed packages. A package that is not installed keeps the row of the page before, and so
do those that it may need.
"""

import argparse
import re
import tomllib
from dataclasses import dataclass
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "licences.md"
FOR_DEVELOPERS = {"test", "dev", "docs"}
LONGEST = 60
"""Letters of a licence's name; packages that put the whole text there are named by their classifier."""
HOMES = ("homepage", "home", "source", "source code", "repository", "github", "documentation")
"""Labels of a package's home among its links, the best first."""
HEAD = """# Licences of others

querysplat is under Apache-2.0, and so are the bundled `compact` weights, which are ours. Released files of
[three.js](https://threejs.org) 0.187.0 and [Spark](https://sparkjs.dev) 2.2.0 are part of it, both under the MIT
licence; their licences lie beside them ([more](viewing.md#what-is-in-the-page)). Nothing of the packages below is part
of this repository: `pip` fetches them. The official checkpoints have licences of their own; `querysplat
weights` lists them.

Made by

    python benchmarks/licences.py

from what the packages state of themselves, in the versions of `constraints.txt`.
"""


@dataclass(frozen=True)
class Row:
    """A package; `part` is "base", or the extra that brings it."""

    package: str
    version: str
    licence: str
    home: str
    part: str

    @property
    def line(self) -> str:
        return f"| [{self.package}]({self.home}) | {self.version} | {self.licence} | {self.part} |"


def wanted() -> dict[str, str]:
    """The direct dependencies of querysplat and of its extras for users, with the part that asks for each."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    parts = {"base": project["dependencies"], **project["optional-dependencies"]}
    return {
        normal(line): part for part, lines in parts.items() if part not in FOR_DEVELOPERS for line in reversed(lines)
    }


def closure() -> dict[str, str]:
    """All of them, with the packages that they need in turn on this machine."""
    found = wanted()
    queue = list(found)
    while queue:
        name = queue.pop(0)
        for line in requirements(name):
            if normal(line) not in found:
                found[normal(line)] = found[name]
                queue.append(normal(line))
    return found


def requirements(name: str) -> list[str]:
    """What the installed package needs here; nothing where it is not installed."""
    installed = find(name)
    lines = installed.requires if installed else None
    return [line for line in lines or [] if "extra ==" not in line and not is_elsewhere(line) and find(normal(line))]


def is_elsewhere(line: str) -> bool:
    """Whether a requirement is for other systems than Linux."""
    return bool(re.search(r"(sys_platform|platform_system|os_name)\s*==\s*.(win32|Windows|darwin|Darwin|nt)", line))


def find(name: str) -> Distribution | None:
    try:
        return distribution(name)
    except PackageNotFoundError:
        return None


def normal(line: str) -> str:
    """The name of a package in a requirement, as PyPI compares names."""
    return re.sub(r"[-_.]+", "-", re.split(r"[^\w.-]", line, maxsplit=1)[0]).lower()


def row(name: str, part: str) -> Row | None:
    """The row of an installed package."""
    installed = find(name)
    if installed is None:
        return None
    facts = installed.metadata
    pairs = (line.partition(", ")[::2] for line in facts.get_all("Project-URL") or [])
    links = {label.lower(): link for label, link in pairs}
    stated = (facts.get("Home-page"), *(links.get(label) for label in HOMES))
    home = next((link for link in stated if link), f"https://pypi.org/project/{name}/")
    return Row(facts["Name"], installed.version, licence_of(installed), home, part)


def licence_of(installed: Distribution) -> str:
    """What the package states: an SPDX expression, a short name, or its classifiers."""
    facts = installed.metadata
    classes = [line for line in facts.get_all("Classifier") or [] if line.startswith("License :: ")]
    by_class = ", ".join(line.rpartition(" :: ")[2] for line in classes)
    short = (facts.get("License") or "").strip()
    stated = facts.get("License-Expression") or (short if 0 < len(short) <= LONGEST else "") or by_class
    return stated or "see its files"


def earlier() -> dict[str, Row]:
    """The rows of the page as it stands, by package."""
    text = PAGE.read_text() if PAGE.is_file() else ""
    found = re.findall(r"^\| \[([^\]]+)\]\(([^)]+)\) \| ([^|]+) \| ([^|]+) \| ([^|]+) \|$", text, re.MULTILINE)
    return {normal(name): Row(name, version, licence, home, part) for name, home, version, licence, part in found}


def rows(before: dict[str, Row]) -> list[Row]:
    """Of the packages that are needed, and of those in `before` of which one that is not installed may need."""
    needed = closure()
    open_parts = {part for name, part in wanted().items() if find(name) is None}
    kept = [each for name, each in before.items() if name not in needed and each.part in open_parts]
    return [found for name, part in needed.items() if (found := row(name, part) or before.get(name))] + kept


def main() -> None:
    argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0]).parse_args()
    table = sorted(rows(earlier()), key=lambda each: (each.part != "base", each.part, each.package.lower()))
    lines = [
        "| package | version | licence | brought by |",
        "| --- | --- | --- | --- |",
        *(each.line for each in table),
    ]
    PAGE.write_text(HEAD + "\n" + "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
