"""Tensors as contiguous arrays on the CPU."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor


def as_array(values: Tensor, dtype: torch.dtype | None = None) -> NDArray[Any]:
    """Share a tensor's memory if it has the type and is contiguous on the CPU, else copy it."""
    return values.detach().to("cpu", dtype).contiguous().numpy()


def pulled_back(
    adjoint: Callable[..., None], inputs: Sequence[Tensor], of_pictures: bool
) -> list[Tensor | None]:
    """Return the gradients that an adjoint adds up.

    Args:
        adjoint: Adds to arrays of the shapes of ``inputs``.
        inputs: The finest level of pictures, the coarser ones, and what else was given.
        of_pictures: Whether gradients of pictures are wanted; they take memory. The adjoint gets
            arrays of one pixel where not.
    """
    shapes = [each.shape if of_pictures else (1, 1) for each in inputs[:2]]
    found = [torch.zeros(shape) for shape in shapes]
    found += [torch.zeros(each.shape, dtype=torch.float64) for each in inputs[2:]]
    adjoint(*map(as_array, found))
    pictures = found[:2] if of_pictures else [None, None]
    return [*pictures, *(one.to(each) for one, each in zip(found[2:], inputs[2:], strict=True))]
