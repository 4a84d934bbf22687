"""Tensors as contiguous arrays on the CPU."""

from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor


def as_array(values: Tensor, dtype: torch.dtype | None = None) -> NDArray[Any]:
    """Share a tensor's memory if it has the type and is contiguous on the CPU, else copy it."""
    return values.detach().to("cpu", dtype).contiguous().numpy()
