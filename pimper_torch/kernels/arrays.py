"""Tensors as kernels take them."""

from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor


def as_array(values: Tensor, dtype: torch.dtype | None = None) -> NDArray[Any]:
    """Share a tensor's memory where it has the type and lies in a row, else copy it."""
    return values.detach().to("cpu", dtype).contiguous().numpy()
