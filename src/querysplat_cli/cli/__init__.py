"""The command line: one small file per verb, imported without torch or pycolmap."""

import sys
import traceback

import click

from querysplat_cli.cli.app import app
from querysplat_cli.runtime.errors import ExitCode, QuerySplatError


def main() -> None:
    """Run the command line and exit with a code of `ExitCode`."""
    code = run(sys.argv[1:])
    _forget_handled_interrupt()
    sys.exit(code)


def run(arguments: list[str]) -> int:
    """Run one command, and return its exit code. An error becomes two lines on standard error."""
    try:
        code = app(arguments, prog_name="querysplat", standalone_mode=False)
        if not code:
            return ExitCode.DONE
    except QuerySplatError as error:
        _print_error(error.message, error.hint)
        return error.code
    except click.exceptions.NoArgsIsHelpError as error:
        error.show()
        return ExitCode.BAD_INPUT
    except click.UsageError as error:
        _print_error(error.format_message(), f"See `{error.ctx.command_path if error.ctx else 'querysplat'} --help`.")
        return ExitCode.BAD_INPUT
    except (KeyboardInterrupt, click.Abort):
        pass
    except OSError as error:
        _print_error(str(error), "Check the path, its permissions and the free space.")
        return ExitCode.BAD_INPUT
    except MemoryError:
        _print_error("out of memory", "Use a smaller --max-size, or fewer photos.")
        return ExitCode.BAD_INPUT
    except Exception:
        traceback.print_exc()
        _print_error("this is a bug in querysplat", "Please report it with the traceback above.")
        return ExitCode.BUG
    _print_error("stopped", "Nothing half-written was left behind.")
    return ExitCode.INTERRUPTED


def _forget_handled_interrupt() -> None:
    """Let `python -m querysplat_cli` exit with our code after Ctrl-C, instead of dying of SIGINT.

    CPython sets a mark when KeyboardInterrupt leaves an exec() of a string, which several libraries run. `python -m`
    reads the mark at its end, although the interrupt was handled. Only the next exec() of a string clears it: there is
    no call for that, and os._exit() would skip the clean-up at exit.
    """
    exec("")


def _print_error(message: str, hint: str) -> None:
    print(f"error: {message}", file=sys.stderr)
    if hint:
        print(f"  {hint}", file=sys.stderr)
