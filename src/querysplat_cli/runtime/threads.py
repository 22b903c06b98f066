"""How the threads of torch, numba and COLMAP wait for each other."""

import os
from collections.abc import MutableMapping

PASSIVE_WAITING = {"OMP_WAIT_POLICY": "PASSIVE", "KMP_BLOCKTIME": "0"}
"""For GNU's OpenMP, and for LLVM's and Intel's, which also obey a time of their own."""
OWN_CHOICES = (*PASSIVE_WAITING, "GOMP_SPINCOUNT", "KMP_LIBRARY")
"""With any of these variables users choose for themselves how threads wait."""


def wait_passively(environment: MutableMapping[str, str] = os.environ) -> None:
    """Let idle OpenMP threads sleep, unless the environment already has one of `OWN_CHOICES`.

    By default an idle thread spins. Torch, numba and COLMAP each have a pool of such threads. Beside another busy
    program, spinning threads take the cores from those that have work, and everything takes several times as long.
    OpenMP reads the environment once, so this has an effect only in front of the first import of those libraries.
    """
    if not any(name in environment for name in OWN_CHOICES):
        environment.update(PASSIVE_WAITING)
