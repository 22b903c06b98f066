"""The processes of one training: this one alone, or several that torchrun started."""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import TypeVar

import torch
from torch import Tensor, distributed, nn

from querysplat_cli.runtime.errors import QuerySplatError

T = TypeVar("T")
BARRIER_TIMEOUT = timedelta(hours=12)
"""How long the others wait for a process that still prepares samples."""


@dataclass(frozen=True)
class Processes:
    """This process among all; `local` is its number on its machine."""

    rank: int = 0
    world: int = 1
    local: int = 0

    @property
    def first(self) -> bool:
        return self.rank == 0

    def wait(self) -> None:
        """Return once all processes have called this."""
        if self.world > 1:
            with _in_words():
                distributed.barrier()

    def gather(self, values: Sequence[T]) -> list[T]:
        """The values of all processes, in the order of their ranks."""
        if self.world == 1:
            return list(values)
        everyone: list[list[T]] = [[] for _ in range(self.world)]
        with _in_words():
            distributed.all_gather_object(everyone, list(values))
        return [value for each in everyone for value in each]

    def sum_gradients(self, parameters: Sequence[nn.Parameter]) -> None:
        """Add up the gradients of all processes; a missing one counts as zero."""
        for parameter in parameters:
            if parameter.grad is None:
                parameter.grad = torch.zeros_like(parameter)
        if self.world == 1:
            return
        gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
        flat = torch.cat([gradient.flatten() for gradient in gradients])
        with _in_words():
            distributed.all_reduce(flat)
        for gradient, summed in zip(gradients, flat.split([each.numel() for each in gradients]), strict=True):
            gradient.copy_(summed.view_as(gradient))

    def spread(self, tensors: Sequence[Tensor]) -> None:
        """Give every process the tensors of the first one."""
        if self.world > 1:
            with _in_words():
                for tensor in tensors:
                    distributed.broadcast(tensor, 0)


@contextmanager
def _in_words() -> Iterator[None]:
    """Around a call that all processes make together: torch's error is no bug where another process has ended."""
    try:
        yield
    except RuntimeError as error:
        raise QuerySplatError(
            "another process of this training ended, or cannot be reached", f"Look for its own message. Torch: {error}"
        ) from error


@contextmanager
def joined_processes(device: torch.device) -> Iterator[Processes]:
    """The processes that torchrun started (gloo on CPUs, NCCL on GPUs), or this one alone."""
    world = int(os.environ.get("WORLD_SIZE", "1"))
    if world == 1:
        yield Processes()
        return
    try:
        distributed.init_process_group("nccl" if device.type == "cuda" else "gloo", timeout=BARRIER_TIMEOUT)
    except (RuntimeError, ValueError) as error:  # a variable of torchrun is missing, or the others do not come
        raise QuerySplatError(
            f"the {world} processes of WORLD_SIZE cannot be joined: {error}",
            "Start them with torchrun, or take WORLD_SIZE out of the environment.",
        ) from error
    try:
        yield Processes(distributed.get_rank(), world, int(os.environ.get("LOCAL_RANK", "0")))
    finally:
        distributed.destroy_process_group()
