"""Arguments of kernels, arrays and named tuples of arrays, with the types that numba compiles."""

from typing import Annotated, Any, NamedTuple

from numpy.typing import NDArray

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
    """Image pyramids, one row per photograph: the finest level, and the others concatenated."""

    finest: Floats2
    coarser: Floats2


class FractionRows(NamedTuple):
    """Pyramids of fractions in 255ths, as :class:`PictureRows`."""

    finest: Bytes2
    coarser: Bytes2


class Projection(NamedTuple):
    """Projection of patches into views.

    Attributes:
        rows: Row of each camera's photograph in the pyramids.
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
