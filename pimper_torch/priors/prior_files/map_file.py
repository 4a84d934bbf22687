"""One file of a map, of whichever format, as arrays."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

from pimper_torch.doors.export.openexr import read_exr
from pimper_torch.doors.io.decode import LABELS, MAX_PIXELS, decode
from pimper_torch.runtime.errors import InputError
from pimper_torch.runtime.numpy_files import read_npy, read_npz

PICTURES = (".png", ".jpg", ".jpeg")
FORMATS = (".npz", ".npy", ".exr", *PICTURES)
"""Of several files of one photograph, the first of these is read: least is lost in it."""

VARIANCE = "variance"


class Layer(NamedTuple):
    """A map of a file.

    Attributes:
        values: ``height width channel``: whole numbers of 8 and 16 bits in [0, 1], other values as
            they are; NaN where a PNG is transparent, or MoGe's depth is unknown.
        variance: ``height width``, where the file has it.
        full: Of whole numbers, the level that is 1 in ``values``; else 0.
    """

    values: np.ndarray
    variance: np.ndarray | None = None
    full: int = 0

    @property
    def labelled(self) -> bool:
        """Whether the file holds labels."""
        return 0 < self.full * float(np.nanmax(self.values, initial=0)) < LABELS - 0.5


def read_layer(path: Path, kinds: tuple[str, ...], cut_out: bool = False) -> Layer:
    """Read a map and, where the file has it, its variance.

    Args:
        path: NPZ, NPY, EXR, PNG or JPEG.
        kinds: How names of arrays and channels begin that hold the map.
        cut_out: Whether a picture that is somewhere transparent holds the map as its opacity.
    """
    try:
        suffix = path.suffix.lower()
        if suffix in PICTURES:
            return _picture(path, cut_out)
        if suffix == ".npy":
            return _raster(path, read_npy(path))
        layers = read_npz(path) if suffix == ".npz" else _grouped(read_exr(path, MAX_PIXELS))
    except (ValueError, OSError) as error:
        raise InputError(
            f"{path}: cannot be read, {error}. Write it again, as NPY for instance."
        ) from error
    variance = layers.pop(VARIANCE, None)
    named = [
        name for name in layers if any(part.startswith(kinds) for part in name.lower().split("."))
    ] or list(layers)
    if len(named) != 1:
        raise InputError(
            f"{path}: holds {', '.join(layers) or 'nothing'}; needed: one array or channel called "
            f"{kinds[0]}, or one alone."
        )
    spread = None if variance is None else _raster(path, variance).values[..., 0]
    return _raster(path, layers[named[0]])._replace(variance=spread)


def _grouped(channels: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Put channels of one layer together: R, G and B, or X, Y and Z."""
    layers: dict[str, np.ndarray] = {}
    for name, values in channels.items():
        layer, _, last = name.rpartition(".")
        three = next((some for some in ("RGB", "XYZ") if last in some and last), "")
        parts = [f"{layer}.{one}".lstrip(".") for one in three]
        if parts and all(part in channels for part in parts):
            layers[layer] = np.stack([channels[part] for part in parts], axis=-1)
        elif last != "A":
            layers[name] = values
    return layers


def _raster(path: Path, values: np.ndarray) -> Layer:
    """Return an array as ``height width channel``, without axes of length 1 that lead."""
    shape, kind = values.shape, values.dtype.kind
    if kind not in "biuf":
        raise InputError(f"{path}: holds {values.dtype}; needed: real numbers.")
    while values.ndim > 2 and values.shape[0] == 1:
        values = values[0]
    if values.ndim == 3 and values.shape[0] == 3 and values.shape[2] != 3:
        values = np.moveaxis(values, 0, -1)
    values = values[..., None] if values.ndim == 2 else values
    full = int(kind != "f")
    if values.dtype in (np.uint8, np.uint16):
        full = np.iinfo(values.dtype).max
        values = values / np.float32(full)
    if values.ndim != 3 or values.shape[2] not in (1, 3) or not 0 < values.size <= 3 * MAX_PIXELS:
        stack = f"{shape}, a stack of {shape[0]} maps" if len(shape) > 2 else f"{shape}"
        raise InputError(
            f"{path}: has shape {stack}; needed: height width, with 3 channels first or "
            "last for normals. Write maps apart, under the names of their photographs."
        )
    return Layer(np.asarray(values, np.float32), full=full)


def _picture(path: Path, cut_out: bool) -> Layer:
    """Read samples; MoGe's depth, whose levels are logarithms, becomes depth."""
    decoded = decode(path)
    if cut_out and decoded.alpha is not None and bool((decoded.alpha < 1).any()):
        return Layer(decoded.alpha.numpy()[..., None])
    values, full = decoded.samples.numpy().transpose(1, 2, 0), decoded.full
    with Image.open(path, formats=("PNG", "JPEG")) as image:
        near, far = (image.info.get(name) for name in ("near", "far"))
        pages = getattr(image, "n_frames", 1)
    if pages > 1:
        raise InputError(f"{path}: has {pages} pages; needed: one map a file. Write them apart.")
    if near is not None and far is not None and decoded.bits == 16:
        levels = np.rint(values * full)
        part = (levels - 1) / 65533  # 0 is unknown, 65535 infinitely far
        values = np.float32(near) ** (1 - part) * np.float32(far) ** part
        values = np.where((levels == 0) | (levels == full), np.float32(np.nan), values)
        full = 0
    if decoded.alpha is not None:
        values = np.where(decoded.alpha.numpy()[..., None] < 1, np.float32(np.nan), values)
    return Layer(values, full=full)
