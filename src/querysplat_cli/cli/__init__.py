"""The command line: one small file per verb, imported without torch or pycolmap."""

import sys
import traceback
from typing import Any

import typer

from querysplat_cli.cli.app import app
from querysplat_cli.runtime.errors import ExitCode, QuerySplatError

UsageError: Any = typer.BadParameter.__bases__[0]
"""typer's, wherever it takes its click from."""


def main() -> None:
    """Run the command line and exit with a code of `ExitCode`."""
    code = run(sys.argv[1:])
    # Where Ctrl-C came while a library ran exec() on a string, `python -m` takes it for unhandled, though it was
    # handled, and dies of SIGINT instead of exiting with our code. The next exec() puts that right.
    exec("")
    sys.exit(code)


def run(arguments: list[str]) -> int:
    """Run one command; errors become two lines on standard error and the exit code that is returned."""
    try:
        stopped = app(arguments, standalone_mode=False)  # typer returns 130 for Ctrl-C
        if not stopped:
            return ExitCode.DONE
    except QuerySplatError as error:
        _say(error.message, error.hint)
        return error.code
    except UsageError as error:
        _say(error.format_message(), f"See `{error.ctx.command_path if error.ctx else 'querysplat'} --help`.")
        return ExitCode.BAD_INPUT
    except (KeyboardInterrupt, typer.Abort):
        pass
    except OSError as error:
        _say(str(error), "Check the path, its permissions and the free space.")
        return ExitCode.BAD_INPUT
    except MemoryError:
        _say("out of memory", "Use a smaller --max-size, or fewer photos.")
        return ExitCode.BAD_INPUT
    except Exception:
        traceback.print_exc()
        _say("this is a bug in querysplat", "Please report it with the traceback above.")
        return ExitCode.BUG
    _say("stopped", "Nothing half-written was left behind.")
    return ExitCode.INTERRUPTED


def _say(message: str, hint: str) -> None:
    print(f"error: {message}", file=sys.stderr)
    if hint:
        print(f"  {hint}", file=sys.stderr)
