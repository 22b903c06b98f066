"""The pages of `--help`: options in panels, examples after them, and two columns that fit 80 characters."""

from collections.abc import Iterable
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from querysplat_cli.cli.examples import EXAMPLES
from querysplat_cli.cli.panels import PANELS

OTHERS = "Others"
"""The panel of what `PANELS` does not list: --help, and the options of the application itself."""


class VerbHelp(TyperCommand):
    """A verb whose help has panels and examples."""

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """The arguments as the panels name them, without typer's braces."""
        return [piece.replace("{", "").replace("}", "") for piece in super().collect_usage_pieces(ctx)]

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write each panel that has an option, in the order of `PANELS`."""
        panels: dict[str, dict[str, tuple[str, str]]] = {}
        for param in self.get_params(ctx):
            row = _row(param, ctx)
            if row is not None:
                panels.setdefault(panel_of(param.name or ""), {})[param.name or ""] = row
        for panel in (*PANELS, OTHERS):
            rows = panels.get(panel, {})
            names = sorted(rows, key=PANELS[panel].index) if panel in PANELS else rows
            _write(formatter, panel, (rows[name] for name in names))

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """Write the verb's examples, if it has any."""
        rows = ((f"querysplat {command}", meaning) for command, meaning in EXAMPLES.get(self.name or "", ()))
        _write(formatter, "Examples", rows)


class ApplicationHelp(TyperGroup):
    """The application, whose help has its verbs in panels."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the verbs, each with its first sentence."""
        panels: dict[str, list[tuple[str, str]]] = {}
        for name, command in self.commands.items():
            panel = getattr(command, "rich_help_panel", None) or OTHERS
            panels.setdefault(panel, []).append((name, (command.help or "").partition("\n\n")[0].replace("\n", " ")))
        for panel, rows in panels.items():
            _write(formatter, panel, rows)

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the verbs first, because they are what a newcomer looks for."""
        self.format_commands(ctx, formatter)
        rows = (param.get_help_record(ctx) for param in self.get_params(ctx))
        _write(formatter, "Options", (row for row in rows if row))


def panel_of(option: str) -> str:
    """The panel of the option whose field is called `option`."""
    return next((panel for panel, names in PANELS.items() if option in names), OTHERS)


def _row(param: Any, ctx: Any) -> tuple[str, str] | None:
    """The name and the help of an option; of an argument without its type, which is a word of Python."""
    row: tuple[str, str] | None = param.get_help_record(ctx)
    if row and param.param_type_name == "argument":
        return (param.metavar or param.name.upper()).strip("[]"), param.help or ""
    return row


def _write(formatter: Any, panel: str, rows: Iterable[tuple[str, str]]) -> None:
    found = list(rows)
    if found:
        with formatter.section(typer.style(panel, bold=True)):
            formatter.write_dl(found, col_max=24)
