"""The command line: one small file per verb, imported without torch or pycolmap."""

import errno
import sys
import traceback

import typer

from querysplat_cli.cli.app import app
from querysplat_cli.cli.usage_errors import explained
from querysplat_cli.runtime import current_folder, signals
from querysplat_cli.runtime.errors import ExitCode, QuerySplatError, is_out_of_memory
from querysplat_cli.runtime.limits import more_memory
from querysplat_cli.runtime.streams import prepare_streams


def main() -> None:
    """Run the command line and exit with a code of `ExitCode`."""
    prepare_streams()
    signals.catch()
    code = run(sys.argv[1:])
    signals.ignore()
    _forget_handled_interrupt()
    sys.exit(code)


def run(arguments: list[str]) -> int:
    """Run one command, and return its exit code. An error becomes two lines on standard error."""
    try:
        _check_current_folder()
        code = app(arguments or ["--help"], prog_name="querysplat", standalone_mode=False)
    except (KeyboardInterrupt, typer.Abort):
        return _stopped()
    except Exception as error:
        # Libraries that are interrupted, while they are imported above all, raise errors of their own.
        ours = isinstance(error, QuerySplatError) and error.code == signals.exit_code()
        return _stopped() if signals.caught() and not ours else _told(error)
    return _stopped() if code else ExitCode.DONE


def _told(error: Exception) -> int:
    """Print an error in words; returns its exit code."""
    if isinstance(error, QuerySplatError):
        _print_error(error.message, error.hint)
        return error.code
    if isinstance(error, typer.TyperException):
        _print_error(*explained(error))
        return ExitCode.BAD_INPUT
    if isinstance(error, OSError):
        full = error.errno == errno.ENOSPC
        what = f"{error.filename or 'standard output'}: the disk is full" if full else str(error)
        _print_error(what, "Free some space." if full else "Check the path and its permissions.")
        return ExitCode.BAD_INPUT
    if is_out_of_memory(error):
        _print_error("out of memory", more_memory())
        return ExitCode.MISSING_PART
    traceback.print_exception(error)
    _print_error("this is a bug in querysplat", "Please report it with the traceback above.")
    return ExitCode.BUG


def _stopped() -> int:
    _print_error("stopped", signals.kept() or "Nothing half-written was left behind.")
    return signals.exit_code()


def _check_current_folder() -> None:
    """Raise QuerySplatError where the current folder was removed: MKL ends the process with words of its own."""
    if not current_folder.is_there():
        raise QuerySplatError("the current folder was removed", "Enter it again with `cd .`, or another one.")


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
