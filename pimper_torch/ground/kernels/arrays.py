"""Tensors as contiguous arrays on the CPU, and records of arrays that kernels take."""

from collections.abc import Callable, Sequence
from typing import Annotated, Any, NamedTuple

import torch
from numpy.typing import NDArray
from torch import Tensor

Floats1 = Annotated[NDArray[Any], "float32[::1]"]
Floats2 = Annotated[NDArray[Any], "float32[:,::1]"]
Floats3 = Annotated[NDArray[Any], "float32[:,:,::1]"]
Floats4 = Annotated[NDArray[Any], "float32[:,:,:,::1]"]
Floats5 = Annotated[NDArray[Any], "float32[:,:,:,:,::1]"]
Doubles1 = Annotated[NDArray[Any], "float64[::1]"]
Doubles2 = Annotated[NDArray[Any], "float64[:,::1]"]
Doubles3 = Annotated[NDArray[Any], "float64[:,:,::1]"]
Doubles4 = Annotated[NDArray[Any], "float64[:,:,:,::1]"]
Integers1 = Annotated[NDArray[Any], "int64[::1]"]
Integers2 = Annotated[NDArray[Any], "int64[:,::1]"]
Bytes2 = Annotated[NDArray[Any], "uint8[:,::1]"]
Masks3 = Annotated[NDArray[Any], "boolean[:,:,::1]"]
Masks4 = Annotated[NDArray[Any], "boolean[:,:,:,::1]"]


class PictureRows(NamedTuple):
    """Pyramids of photographs, one in a row: the finest level, and the others."""

    finest: Floats2
    coarser: Floats2


class FractionRows(NamedTuple):
    """The same of fractions in 255ths."""

    finest: Bytes2
    coarser: Bytes2


class Projection(NamedTuple):
    """Projection of patches into views.

    Attributes:
        rows: Where each camera's photograph is among the pictures.
        image_from_patch: Three by four, for every patch and view.
        centers_patch: Of the cameras, for every patch and view.
    """

    rows: Integers1
    image_from_patch: Doubles3
    centers_patch: Doubles2


class Samples(NamedTuple):
    """Samples of templates, patch frame; ``outward`` is unit."""

    origin: Doubles2
    spacing: Doubles1
    depth: Floats3
    outward: Floats4


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
