"""The processes that train one model together, and the device that each works on.

A step's batch is made of micro-batches (`TrainConfig.accumulate`), each drawn from a generator of its own. The
processes share them out, each adds up the gradients of its micro-batches, and then all add up theirs: whether one
process did four micro-batches or four did one each, the sum is the same but for its last digits. So every process takes
the same step, nothing but gradients is ever sent, and a run may go on with another number of processes.
Only the first process validates, speaks and writes files.

    accelerate launch --num_processes 4 -m minicmdm train --preset M --data HumanML3D --out runs/M \\
        --device cuda --accumulate 4
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

import torch
from torch import Tensor

T = TypeVar("T")


class Team:
    """One process alone, or (`together`) one among those that `accelerate launch` started, if it did.

    device: "cpu", "cuda", "mps" or any name torch knows; each of several processes gets a GPU of its own.
    workers: threads that draw the next batches while a step is computed; they change no number.
    ValueError: a device this machine has not, or several processes without `accelerate`.
    """

    def __init__(self, device: str = "cpu", together: bool = False, workers: int = 0):
        if workers < 0:
            raise ValueError(f"workers must not be negative, and {workers} came")
        self.workers = workers
        try:
            self.device = torch.device(device)
            torch.zeros(1, device=self.device).item()  # "meta" has tensors, but no numbers
        except (RuntimeError, AssertionError) as error:
            raise ValueError(f"no device {device!r} on this machine: {str(error).splitlines()[0]}") from error
        self.rank, self.size, self._accelerator = 0, 1, None
        if together and int(os.environ.get("WORLD_SIZE", 1)) > 1:
            try:
                from accelerate import Accelerator
            except ImportError as error:
                raise ValueError("several processes need accelerate: pip install 'minicmdm[scale]'") from error
            self._accelerator = Accelerator(cpu=self.device.type == "cpu")
            self.device = self._accelerator.device
            self.rank, self.size = self._accelerator.process_index, self._accelerator.num_processes

    @property
    def first(self) -> bool:
        """Is this the process that validates, speaks and writes?"""
        return self.rank == 0

    def share(self, micro_batches: int) -> range:
        """Which micro-batches of a step are this process's. ValueError: they cannot be shared out evenly."""
        if micro_batches % self.size:
            raise ValueError(
                f"{micro_batches} micro-batches a step cannot be shared evenly by {self.size} processes: "
                f"give --accumulate {self.size} or a multiple of it"
            )
        return range(self.rank, micro_batches, self.size)

    def ahead(self, work: Callable[[int], T], keys: Iterable[int]) -> Iterator[T]:
        """`work` done for each key, in their order; with workers, for the next few keys at the same time."""
        if self.workers == 0:
            yield from map(work, keys)
            return
        with ThreadPoolExecutor(self.workers) as threads:
            waiting: deque[Future[T]] = deque()
            for key in keys:
                waiting.append(threads.submit(work, key))
                if len(waiting) > self.workers:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()

    def add_up(self, tensors: list[Tensor]) -> None:
        """Replace each tensor by its sum over all processes; they go as one, since small messages are slow."""
        if self._accelerator is None:
            return
        flat = torch.cat([tensor.detach().float().flatten() for tensor in tensors])
        total = self._accelerator.reduce(flat, reduction="sum")
        for tensor, part in zip(tensors, total.split([tensor.numel() for tensor in tensors])):
            tensor.copy_(part.view_as(tensor))

    def wait(self) -> None:
        """Go on when all have come this far, as where the first writes what the others read."""
        if self._accelerator is not None:
            self._accelerator.wait_for_everyone()


ALONE = Team()
