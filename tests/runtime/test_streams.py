"""Output that nobody reads ends no run."""

import subprocess
import sys

import pytest

PROGRAM = """
import sys, time
from querysplat_cli.runtime.streams import tolerate_closed_streams
tolerate_closed_streams()
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
