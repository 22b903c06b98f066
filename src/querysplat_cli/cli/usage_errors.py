"""Wrong usage of the command line, in two lines: what is wrong, and what was probably meant."""

import difflib
import os
from contextlib import suppress
from typing import Any

CLOSE = 0.7
"""How alike a word and an option must be to be suggested, from 0 to 1 (difflib's ratio)."""

MOST_VERBS = 4
"""The verbs that have an option are named up to so many."""


def explained(error: Any) -> tuple[str, str]:
    """The message and the hint of one of typer's errors, whose own class of usage errors is private."""
    context = getattr(error, "ctx", None)
    path = context.command_path if context else "querysplat"
    see = f"See `{path} --help`."
    option = getattr(error, "option_name", None)
    if option is not None and context is not None:
        hint = f"{_file_meant(option) or _meant(option, context)}{see}"
        return f"{path.partition(' ')[2] or path} has no option {option}", hint
    message = error.format_message()
    word = message.partition("'")[2].partition("'")[0]
    if message.startswith("No such command") and word and os.path.exists(word):
        return message.partition(" Did you mean")[0], f"To make a scene of it: querysplat reconstruct {word}"
    return message, see


def _file_meant(option: str) -> str:
    """A file of the current folder whose name was taken for `option`, of which the parser may have read one letter."""
    start = option.partition("/")[0]
    with suppress(OSError):
        file = min((name for name in os.listdir() if name.startswith(start)), default=None)
        return f"For the file {file}, write ./{file}. " if file else ""
    return ""


def _meant(option: str, context: Any) -> str:
    """The option of this verb that is most like `option`, or else the verbs that have an option of that name."""
    near = difflib.get_close_matches(option, _names(context.command), n=2, cutoff=CLOSE)
    verbs = getattr(context.find_root().command, "commands", {})
    elsewhere = [name for name, command in verbs.items() if option in _names(command)]
    if len(elsewhere) > MOST_VERBS:
        return f"It is an option of verbs, as in `querysplat {elsewhere[0]} {option}`. "
    if elsewhere:
        return f"It is an option of {' and '.join(elsewhere)}. "
    return f"Did you mean {' or '.join(near)}? " if near else ""


def _names(command: Any) -> list[str]:
    options = (param for param in command.params if param.param_type_name == "option")
    return [name for option in options for name in (*option.opts, *option.secondary_opts) if name.startswith("--")]
