"""The processes of one training: this one alone, or several that torchrun started."""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import TypeVar

import torch
from torch import Tensor, distributed, nn

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
            distributed.barrier()

    def gather(self, values: Sequence[T]) -> list[T]:
        """The values of all processes, in the order of their ranks."""
        if self.world == 1:
            return list(values)
        everyone: list[list[T]] = [[] for _ in range(self.world)]
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
        distributed.all_reduce(flat)
        for gradient, summed in zip(gradients, flat.split([each.numel() for each in gradients]), strict=True):
            gradient.copy_(summed.view_as(gradient))

    def spread(self, tensors: Sequence[Tensor]) -> None:
        """Give every process the tensors of the first one."""
        if self.world > 1:
            for tensor in tensors:
                distributed.broadcast(tensor, 0)


@contextmanager
def joined_processes(device: torch.device) -> Iterator[Processes]:
    """The processes that torchrun started (gloo on CPUs, NCCL on GPUs), or this one alone."""
    world = int(os.environ.get("WORLD_SIZE", "1"))
    if world == 1:
        yield Processes()
        return
    distributed.init_process_group("nccl" if device.type == "cuda" else "gloo", timeout=BARRIER_TIMEOUT)
    try:
        yield Processes(distributed.get_rank(), world, int(os.environ.get("LOCAL_RANK", "0")))
    finally:
        distributed.destroy_process_group()
