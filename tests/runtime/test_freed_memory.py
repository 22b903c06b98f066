"""Memory that is used is counted, and what nothing uses any more goes back to the system."""

import os
import platform
import subprocess
import sys

import pytest
import torch

from querysplat_cli.model.anchors import Neighbours
from querysplat_cli.runtime.device import tensor_bytes

PROGRAM = """
from pathlib import Path
from querysplat_cli.runtime.device import return_freed_memory

def held() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 // 2**20

blocks = [bytes([1]) * 100_000 for _ in range(2_000)]
kept = blocks[::100]
del blocks
before = held()
return_freed_memory()
print(before - held())
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library has other ways")
def test_blocks_between_others_that_are_kept_go_back() -> None:
    """Ten training samples of different sizes left 2 GiB behind that nothing used."""
    # glibc gives blocks of more than this back by itself.
    own = os.environ | {"MALLOC_MMAP_THRESHOLD_": "1000000", "MALLOC_TRIM_THRESHOLD_": "1000000000"}
    done = subprocess.run([sys.executable, "-c", PROGRAM], env=own, capture_output=True, text=True, check=True)
    assert int(done.stdout) > 150  # MiB, of 190


def test_the_bytes_of_tensors_in_tuples_and_dataclasses() -> None:
    near = Neighbours(torch.zeros(2, 4, dtype=torch.long), torch.zeros(2, 4))
    assert tensor_bytes((torch.zeros(3), near, None)) == 12 + 64 + 32
