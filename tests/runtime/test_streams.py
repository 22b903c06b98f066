"""Output that nobody reads ends no run."""

import subprocess
import sys

import pytest

PROGRAM = """
import sys, time
from querysplat_cli.runtime.streams import prepare_streams
prepare_streams()
for i in range(20000):
    print("line", i)
    print("message", i, file=sys.stderr)
print("\\u00e9\\ud800")
opened = open(sys.argv[1], "w")
opened.write("done")
opened.close()
"""


def shell(command: str, tmp_path: object) -> subprocess.CompletedProcess[str]:
    """Run PROGRAM with the shell's redirections in `command`, which has its place at {}."""
    program = f'{sys.executable} -c "$PROGRAM" {tmp_path}/result'
    script = f"set -o pipefail; {command.format(program)}"
    environment = {"PROGRAM": PROGRAM, "PYTHONPATH": ":".join(sys.path), "PYTHONIOENCODING": "ascii"}
    return subprocess.run(
        ["bash", "-c", script], env=environment, capture_output=True, text=True, check=False, timeout=60
    )


@pytest.mark.parametrize(
    "command",
    [
        "{}",
        "{} | head -1",
        "{} 2>&1 | head -1",
        "{} 2>&-",
        "{} >&-",
        "{} >&- 2>&- <&-",
        "{} 2>&1 >/dev/null | true",
        "{} 2>/dev/full",
    ],
)
def test_the_run_is_finished_with_its_own_code(command: str, tmp_path: object) -> None:
    done = shell(command, tmp_path)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr + done.stdout
    assert "BrokenPipe" not in done.stderr
    with open(f"{tmp_path}/result") as file:
        assert file.read() == "done"


LIBRARY = """
import os
from querysplat_cli.runtime.streams import prepare_streams
prepare_streams()
os.write(1, b"words of a library\\n")
print("result")
"""


def test_results_are_alone_on_standard_output() -> None:
    done = subprocess.run([sys.executable, "-c", LIBRARY], capture_output=True, text=True, check=True, timeout=60)
    assert (done.stdout, done.stderr) == ("result\n", "words of a library\n")
