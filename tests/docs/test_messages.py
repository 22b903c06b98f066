"""The messages that docs/troubleshooting.md explains are messages of the program, word by word."""

import ast
import re
from pathlib import Path

import pytest

import querysplat_cli

PAGE = (Path(__file__).parents[2] / "docs" / "troubleshooting.md").read_text()
SOURCES = Path(querysplat_cli.__file__).parent.rglob("*.py")
TABLES = PAGE.partition("## A scene that looks wrong")[0]
MESSAGES = re.findall(r"^\| `([^`]+)` \|", TABLES, re.MULTILINE)


@pytest.fixture(scope="module")
def texts() -> str:
    """Every text of the package's code; what varies in a message parts it into several."""
    nodes = (node for path in SOURCES for node in ast.walk(ast.parse(path.read_text())))
    return "\n".join(node.value for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, str))


def test_there_are_messages_on_the_page() -> None:
    assert len(MESSAGES) > 20


@pytest.mark.parametrize("message", MESSAGES)
def test_a_message_on_the_page_is_one_of_the_program(message: str, texts: str) -> None:
    for part in message.split("…"):
        assert part.strip() in texts
