"""A file of a map, in any format, as arrays."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

from pimper_torch.io.decode import LABELS, MAX_PIXELS, decode
from pimper_torch.io.openexr import read_exr
from pimper_torch.runtime.errors import InputError
from pimper_torch.runtime.numpy_files import read_npy, read_npz

PICTURES = (".png", ".jpg", ".jpeg")
FORMATS = (".npz", ".npy", ".exr", *PICTURES)
"""Formats in the order of preference, from the least to the most loss."""

VARIANCE = "variance"


class Layer(NamedTuple):
    """A map of a file.

    Attributes:
        values: ``height width channel``: integers of 8 and 16 bits scaled to [0, 1], other values
            unchanged; NaN where a PNG is transparent, or MoGe's depth is unknown.
        variance: ``height width``, if the file has it.
        full: For integers, the level that is 1 in ``values``; else 0.
    """

    values: np.ndarray
    variance: np.ndarray | None = None
    full: int = 0

    @property
    def labelled(self) -> bool:
        """Whether the file contains labels."""
        return 0 < self.full * float(np.nanmax(self.values, initial=0)) < LABELS - 0.5


def read_layer(path: Path, kinds: tuple[str, ...], cut_out: bool = False) -> Layer:
    """Read a map and, if the file has it, its variance.

    Args:
        path: NPZ, NPY, EXR, PNG or JPEG.
        kinds: Prefixes of the names of arrays and channels with the map.
        cut_out: Whether the map is the opacity of an image with transparent pixels.
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
            f"{path}: cannot be read: {error}. Write it again, for instance as NPY."
        ) from error
    variance = layers.pop(VARIANCE, None)
    named = [
        name for name in layers if any(part.startswith(kinds) for part in name.lower().split("."))
    ] or list(layers)
    if len(named) != 1:
        raise InputError(
            f"{path}: contains {', '.join(layers) or 'nothing'}; needed: one array or channel "
            f"named {kinds[0]}, or only one."
        )
    raster = None if variance is None else _raster(path, variance).values[..., 0]
    return _raster(path, layers[named[0]])._replace(variance=raster)


def _grouped(channels: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Stack channels of the same layer: R, G and B, or X, Y and Z."""
    layers: dict[str, np.ndarray] = {}
    for name, values in channels.items():
        layer, _, last = name.rpartition(".")
        triple = next((letters for letters in ("RGB", "XYZ") if last in letters and last), "")
        members = [f"{layer}.{letter}".lstrip(".") for letter in triple]
        if members and all(member in channels for member in members):
            layers[layer] = np.stack([channels[member] for member in members], axis=-1)
        elif last != "A":
            layers[name] = values
    return layers


def _raster(path: Path, values: np.ndarray) -> Layer:
    """Return an array as ``height width channel``, without leading axes of length 1."""
    shape, kind = values.shape, values.dtype.kind
    if kind not in "biuf":
        raise InputError(f"{path}: contains {values.dtype}; needed: real numbers.")
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
            "last for normals. Write each map to its own file, named like its photograph."
        )
    return Layer(np.asarray(values, np.float32), full=full)


def _picture(path: Path, cut_out: bool) -> Layer:
    """Read samples of an image; the logarithmic levels of MoGe's depth are converted to depth."""
    decoded = decode(path)
    if cut_out and decoded.alpha is not None and bool((decoded.alpha < 1).any()):
        return Layer(decoded.alpha.numpy()[..., None])
    values, full = decoded.samples.numpy().transpose(1, 2, 0), decoded.full
    with Image.open(path, formats=("PNG", "JPEG")) as image:
        near, far = (image.info.get(name) for name in ("near", "far"))
        pages = getattr(image, "n_frames", 1)
    if pages > 1:
        raise InputError(f"{path}: has {pages} pages; needed: a separate file for each map.")
    if near is not None and far is not None and decoded.bits == 16:
        levels = np.rint(values * full)
        fraction = (levels - 1) / 65533  # 0 is unknown, 65535 infinitely far
        values = np.float32(near) ** (1 - fraction) * np.float32(far) ** fraction
        values = np.where((levels == 0) | (levels == full), np.float32(np.nan), values)
        full = 0
    if decoded.alpha is not None:
        values = np.where(decoded.alpha.numpy()[..., None] < 1, np.float32(np.nan), values)
    return Layer(values, full=full)
