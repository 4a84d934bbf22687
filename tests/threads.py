"""Run a function with several numbers of threads."""

from collections.abc import Callable, Iterator
from typing import TypeVar

import torch

Result = TypeVar("Result")


def on_threads(work: Callable[[], Result], *counts: int) -> Iterator[Result]:
    """Call ``work`` once for each number of torch's threads; the number is restored."""
    former = torch.get_num_threads()
    try:
        for count in counts:
            torch.set_num_threads(count)
            yield work()
    finally:
        torch.set_num_threads(former)
