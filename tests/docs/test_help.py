"""The help of the command line: every option in a panel, every verb with examples that can be run, 80 columns."""

import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command

from querysplat_cli.cli import run
from querysplat_cli.cli.app import app
from querysplat_cli.cli.examples import EXAMPLES
from querysplat_cli.cli.help_pages import OTHERS, panel_of
from querysplat_cli.cli.panels import PANELS
from querysplat_cli.runtime.optional_parts import OPTIONAL_PARTS

APPLICATION: Any = get_command(app)
VERBS = sorted(APPLICATION.commands)
ROOT = Path(__file__).parents[2]
FOR_DEVELOPERS = {"test", "dev", "docs"}
"""Extras that users of the command line have no use for."""


def help_of(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert run([*arguments, "--help"]) == 0
    return capsys.readouterr().out


@pytest.mark.parametrize("verb", VERBS)
def test_every_option_has_a_panel(verb: str) -> None:
    """An option that is new belongs into `PANELS` of cli/panels.py."""
    assert [param.name for param in APPLICATION.commands[verb].params if panel_of(param.name) == OTHERS] == []


def test_panels_name_each_option_once_and_only_options_that_exist() -> None:
    listed = [name for names in PANELS.values() for name in names]
    assert len(listed) == len(set(listed))
    assert set(listed) == {param.name for verb in VERBS for param in APPLICATION.commands[verb].params}


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_has_examples_of_its_own_that_the_parser_takes(verb: str) -> None:
    """An example belongs into `EXAMPLES` of cli/examples.py."""
    assert EXAMPLES[verb]
    for command, meaning in EXAMPLES[verb]:
        first, *arguments = command.split()
        assert first == verb
        assert meaning
        assert APPLICATION.commands[verb].make_context(verb, arguments)


@pytest.mark.parametrize("verb", VERBS)
def test_the_help_of_a_verb_shows_panels_in_order_and_examples_last(
    verb: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    text = help_of(capsys, verb)
    assert max(map(len, text.splitlines())) <= 80
    headings = [line[:-1] for line in text.splitlines() if line.endswith(":") and not line.startswith(" ")]
    own = {panel_of(param.name) for param in APPLICATION.commands[verb].params}
    assert headings == [*(panel for panel in PANELS if panel in own), OTHERS, "Examples"]
    for param in APPLICATION.commands[verb].params:
        assert (param.opts[0] if param.param_type_name == "option" else param.metavar or param.name.upper()) in text
    assert text.count(f"  querysplat {verb}") == len(EXAMPLES[verb])


def test_a_bare_command_shows_every_verb(capsys: pytest.CaptureFixture[str]) -> None:
    assert run([]) == 0
    text = capsys.readouterr().out
    assert [verb for verb in VERBS if f"\n  {verb} " not in text] == []
    assert "--version" in text
    assert OTHERS not in text


def test_the_version_is_that_of_the_package(capsys: pytest.CaptureFixture[str]) -> None:
    from querysplat_cli import __version__

    assert run(["--version"]) == 0
    assert capsys.readouterr().out == f"querysplat {__version__}\n"


@pytest.mark.parametrize(
    ("arguments", "wrong", "hint"),
    [
        (["reconstuct"], "No such command 'reconstuct'. Did you mean 'reconstruct'?", "--help"),
        (["reconstruct", "a", "--ouput", "x"], "reconstruct has no option --ouput", "Did you mean --output?"),
        (["tto", "a", "--holdout-every", "4"], "tto has no option --holdout-every", "an option of reconstruct."),
        (["render", "a", "--zzz"], "render has no option --zzz", "See `querysplat render --help`."),
        (["--json"], "querysplat has no option --json", "as in `querysplat reconstruct --json`."),
        (["--verson"], "querysplat has no option --verson", "Did you mean --version?"),
        (["."], "No such command '.'.", "querysplat reconstruct ."),
    ],
)
def test_what_was_probably_meant_is_said(
    arguments: list[str], wrong: str, hint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(arguments) == 2
    first, second = capsys.readouterr().err.splitlines()
    assert first == f"error: {wrong}"
    assert hint in second


def test_a_file_that_was_taken_for_options_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "-rf.jpg").touch()
    monkeypatch.chdir(tmp_path)
    assert run(["reconstruct", "-rf.jpg"]) == 2
    assert "For the file -rf.jpg, write ./-rf.jpg." in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        ("querysplat rec", ["reconstruct"]),
        ("querysplat reconstruct --hold", ["--holdout-every", "--holdout-cameras"]),
        ("querysplat reconstruct --quality ", ["draft", "standard", "high", "max"]),
        ("querysplat eval --scales m", ["medium"]),
        ("querysplat reconstruct --poses d", []),
    ],
)
def test_a_shell_completes_verbs_options_and_their_words(words: str, offered: list[str]) -> None:
    """As bash asks for it. Where nothing is offered, bash completes names of files."""
    asked = {"_QUERYSPLAT_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(words.count(" "))}
    command = [sys.executable, "-c", "from querysplat_cli.cli import main; main()"]
    environment = {"PYTHONPATH": ":".join(filter(None, sys.path)), "PATH": "/usr/bin:/bin", **asked}
    found = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert found.stdout.split() == offered


def test_every_extra_for_users_is_an_optional_part() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert {part.extra for part in OPTIONAL_PARTS} == extras.keys() - FOR_DEVELOPERS
    for part in OPTIONAL_PARTS:
        assert any(line.startswith(part.package) for line in extras[part.extra]), part.extra
