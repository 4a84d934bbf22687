"""The choice between compiled kernels and torch."""

import torch
from torch import Tensor


def compiled_for(*tensors: Tensor) -> bool:
    """Return whether compiled kernels can be used: all tensors on the CPU, no gradients."""
    tracked = torch.is_grad_enabled() and any(each.requires_grad for each in tensors)
    return all(each.device.type == "cpu" for each in tensors) and not tracked
