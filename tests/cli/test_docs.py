"""docs/cli.md and the command line have the same options."""

import re
from pathlib import Path

import pytest
from typer.main import get_command

from querysplat_cli.cli.app import app

COMMANDS = get_command(app).commands  # type: ignore[attr-defined]  # it is a group
DOCS = Path(__file__).parents[2] / "docs" / "cli.md"
EVERYWHERE = {"--help", "--quiet", "-q", "--json", "--force", "--seed"}
"""Options that mean the same for every verb; they are documented once."""


def section(verb: str) -> str:
    return re.split(r"^## ", DOCS.read_text().partition(f"\n## {verb}\n")[2], maxsplit=1, flags=re.MULTILINE)[0]


@pytest.mark.parametrize("verb", sorted(COMMANDS))
def test_every_option_is_documented_in_the_section_of_its_verb(verb: str) -> None:
    text = section(verb)
    assert text, f"no section about {verb}"
    named = set(re.findall(r"--?[a-z][a-z-]*", text)) | EVERYWHERE
    options = [param.opts for param in COMMANDS[verb].params if param.param_type_name == "option"]
    assert [names for names in options if not named & set(names)] == []


@pytest.mark.parametrize("verb", sorted(COMMANDS))
def test_tables_name_only_options_that_exist(verb: str) -> None:
    rows = [line.split("|")[1] for line in section(verb).splitlines() if line.startswith("| `-")]
    known = {name for param in COMMANDS[verb].params for name in (*param.opts, *param.secondary_opts)}
    named = {name for row in rows for name in re.findall(r"--?[a-z][a-z-]*", row)}
    assert named <= known
