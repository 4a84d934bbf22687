"""The choice between compiled kernels and torch."""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Literal

import torch
from torch import Tensor

Kernels = Literal["numba", "torch"]

_chosen: ContextVar[Kernels] = ContextVar("kernels", default="numba")


@contextmanager
def using(kernels: Kernels) -> Iterator[None]:
    """Choose inside the ``with`` block whether kernels stand in for torch."""
    token = _chosen.set(kernels)
    try:
        yield
    finally:
        _chosen.reset(token)


def compiled_for(*tensors: Tensor) -> bool:
    """Return whether compiled kernels may be used: chosen, tensors on the CPU, no gradients."""
    tracked = torch.is_grad_enabled() and any(each.requires_grad for each in tensors)
    on_cpu = all(each.device.type == "cpu" for each in tensors)
    return _chosen.get() == "numba" and on_cpu and not tracked
