"""Several processes of one training."""

import pytest
import torch
from torch import distributed

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.training.processes import Processes, joined_processes


def test_the_end_of_another_process_is_no_bug(monkeypatch: pytest.MonkeyPatch) -> None:
    """The others said so with a traceback, below which the reason was hardly found."""

    def fail(*_: object) -> None:
        raise RuntimeError("Connection reset by peer")

    for name in ("barrier", "all_gather_object", "all_reduce", "broadcast"):
        monkeypatch.setattr(distributed, name, fail)
    processes, parameter = Processes(rank=1, world=2), torch.nn.Parameter(torch.zeros(1))
    for call in (
        processes.wait,
        lambda: processes.gather([1]),
        lambda: processes.sum_gradients([parameter]),
        lambda: processes.spread([parameter]),
    ):
        with pytest.raises(QuerySplatError, match="another process of this training ended"):
            call()


def test_world_size_without_torchrun_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """As where it is still set for --dry-run. It ended in a traceback."""
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.delenv("RANK", raising=False)
    with (
        pytest.raises(QuerySplatError, match="the 2 processes of WORLD_SIZE cannot be joined"),
        joined_processes(torch.device("cpu")),
    ):
        pass
