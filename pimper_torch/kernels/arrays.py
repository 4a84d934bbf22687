"""Conversion of tensors to contiguous arrays on the CPU."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor


def as_array(values: Tensor, dtype: torch.dtype | None = None) -> NDArray[Any]:
    """Return a tensor as array: its memory if of that type and contiguous on the CPU, or a copy."""
    return values.detach().to("cpu", dtype).contiguous().numpy()


def pulled_back(
    adjoint: Callable[..., None], inputs: Sequence[Tensor], of_pictures: bool
) -> list[Tensor | None]:
    """Return the gradients of the inputs, computed by an adjoint.

    Args:
        adjoint: Adds to arrays with the shapes of ``inputs``.
        inputs: The finest level of pictures, the coarser ones, and the other inputs.
        of_pictures: Whether gradients of pictures, which take memory, are needed. If not, the
            adjoint gets arrays of one pixel for them, and ``None`` is returned.
    """
    pictures, others = inputs[:2], inputs[2:]
    gradients = [torch.zeros(values.shape if of_pictures else (1, 1)) for values in pictures]
    gradients += [torch.zeros(values.shape, dtype=torch.float64) for values in others]
    adjoint(*map(as_array, gradients))
    first = gradients[:2] if of_pictures else [None, None]
    return [*first, *(g.to(values) for g, values in zip(gradients[2:], others, strict=True))]
