"""Arrays from MATLAB files of version 5 to 7, and cameras of its calibration toolbox.

SciPy's reader crashes on some damaged files. This reader also limits memory by the size of the
file.

Source: MathWorks, MAT-File Format, "MAT-File Level 5".
"""

import math
import struct
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.io.cameras.layout import DataSetPath
from pimper_torch.runtime.errors import some

# Number types by their code in the file, and array classes of numbers.
_KINDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8"}
_KINDS |= {12: "i8", 13: "u8"}
_CLASSES = {6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4"}
_CLASSES |= {14: "i8", 15: "u8"}
_MATRIX, _COMPRESSED, _COMPLEX = 14, 15, 0x0800
# A choice: the largest array of the published sets has 0.1 GB.
MAX_BYTES = 2**29


def read_variables(
    path: Path | str, wanted: Callable[[str], bool] = lambda name: True
) -> dict[str, np.ndarray | None]:
    """Read the real numeric arrays whose names are wanted; ``None`` for other variables.

    Raises:
        ValueError: The file is not of this kind, is truncated, or unpacks to more than 512 MB.
    """
    data = Path(path).read_bytes()
    if len(data) < 128 or data[126:128] not in (b"IM", b"MI"):
        raise ValueError("it is not a MATLAB file of version 5 to 7")
    order = "<" if data[126:128] == b"IM" else ">"
    if struct.unpack_from(f"{order}H", data, 124)[0] != 0x0100:
        raise ValueError("its version is 7.3 or unknown")
    arrays: dict[str, np.ndarray | None] = {}
    offset, budget = 128, MAX_BYTES
    while offset + 8 <= len(data):
        kind, size = struct.unpack_from(f"{order}2I", data, offset)
        body = data[offset + 8 : offset + 8 + size]
        if len(body) < size:
            raise ValueError("it is truncated")
        offset += 8 + size
        if kind == _COMPRESSED:
            body = _unpacked(body, budget)
            budget -= len(body)
            kind, size = struct.unpack_from(f"{order}2I", body) if len(body) >= 8 else (0, 0)
            body = body[8 : 8 + size]
        if kind == _MATRIX:
            name, array = _variable(body, order, wanted)
            arrays[name] = array
    return arrays


def _unpacked(body: bytes, budget: int) -> bytes:
    try:
        unpacker = zlib.decompressobj()
        unpacked = unpacker.decompress(body, max(budget, 1))
    except zlib.error as error:
        raise ValueError("its compressed data are damaged") from error
    if not unpacker.eof and (unpacker.unconsumed_tail or len(unpacked) >= budget):
        raise ValueError(f"its arrays would take more than {MAX_BYTES} bytes")
    return unpacked


def _variable(
    body: bytes, order: str, wanted: Callable[[str], bool]
) -> tuple[str, np.ndarray | None]:
    _, flags, offset = _element(body, 0, order)
    if len(flags) < 8:
        raise ValueError("a variable has no class")
    (flag,) = struct.unpack_from(f"{order}I", flags)
    _, sides, offset = _element(body, offset, order)
    shape = np.frombuffer(sides[: len(sides) // 4 * 4], f"{order}i4").tolist()
    _, name, offset = _element(body, offset, order)
    text = name.decode("latin-1")
    if flag & 0xFF not in _CLASSES or flag & _COMPLEX or not wanted(text):
        return text, None
    kind, values, _ = _element(body, offset, order)
    if kind not in _KINDS or not 2 <= len(shape) <= 8 or any(side < 0 for side in shape):
        raise ValueError(f"{text[:40]!r} has no valid type or shape")
    packed = np.dtype(f"{order}{_KINDS[kind]}")
    if math.prod(shape) * packed.itemsize != len(values):
        raise ValueError(f"{text[:40]!r} has the shape {shape}, but {len(values)} bytes")
    array = np.frombuffer(values, packed).astype(_CLASSES[flag & 0xFF])
    return text, array.reshape(shape, order="F")


def _element(body: bytes, offset: int, order: str) -> tuple[int, bytes, int]:
    """Return type and bytes of an element (short ones are in the tag), and the next offset."""
    if offset + 8 > len(body):
        raise ValueError("a variable is truncated")
    (word,) = struct.unpack_from(f"{order}I", body, offset)
    if word >> 16:
        size = word >> 16
        if size > 4:
            raise ValueError("a variable has an invalid tag")
        return word & 0xFFFF, body[offset + 4 : offset + 4 + size], offset + 8
    (size,) = struct.unpack_from(f"{order}I", body, offset + 4)
    if size > len(body) - offset - 8:
        raise ValueError("a variable is truncated")
    return word, body[offset + 8 : offset + 8 + size], offset + 8 + size + -size % 8


_FORMAT = "a MATLAB file of version 5 to 7"


def read_matlab(file: DataSetPath, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Read numeric arrays of a MATLAB file (up to version 7)."""
    variables = _variables(file, names)
    absent = [name for name in names if name not in variables]
    present = some(sorted(variables), most=12) or "none"
    file.expect(not absent, f"the variables {some(absent)}", f"variables {present}")
    arrays = {}
    for name in names:
        array = variables[name]
        if array is None:
            file.refuse(f"real numbers in {name}", "a different class")
        arrays[name] = array
    return arrays


def _variables(file: DataSetPath, names: Sequence[str] = ()) -> dict[str, np.ndarray | None]:
    """Read arrays of these names; other variables are ``None``."""
    return file.read(lambda path: read_variables(path, lambda name: name in names), _FORMAT)


def read_toolbox_projections(
    file: DataSetPath, numbers: Sequence[int]
) -> Float[Tensor, "view 3 4"]:
    """Read ``K [R | t]`` from files of Bouguet's calibration toolbox for MATLAB.

    ``KK`` (or ``fc`` and ``cc``) are the intrinsics, ``Rc_<i>`` and ``Tc_<i>`` transform points
    from the world to camera i. The toolbox counts pixel centres from 0. Lens distortion
    (``kc``) is ignored: sets in this form are used without it.

    Args:
        file: ``Calib_Results.mat``.

    Returns:
        Projections in float64 on pixels counted from the centre of the first one. ``R`` is
        not corrected: in published files it is not exactly orthogonal, which
        :func:`~pimper_torch.io.cameras.camera_arrays.decompose_projections` handles.
    """
    poses = [name for number in numbers for name in (f"Rc_{number}", f"Tc_{number}")]
    intrinsic = ["KK"] if "KK" in _variables(file) else ["fc", "cc"]
    arrays = read_matlab(file, [*intrinsic, *poses])

    def shaped(name: str, *shape: int) -> Float[Tensor, "..."]:
        array = arrays[name]
        fits = array.shape == shape or (1 in shape and array.size == max(shape))
        expected, actual = (" x ".join(map(str, sides)) for sides in (shape, array.shape))
        needed = f"{name} as finite numbers of shape {expected}"
        file.expect(fits and bool(np.isfinite(array).all()), needed, f"shape {actual}")
        return torch.from_numpy(array.astype(np.float64).reshape(shape))

    if "KK" in arrays:
        K = shaped("KK", 3, 3)
    else:
        K = torch.eye(3, dtype=torch.float64)
        K[[0, 1], [0, 1]], K[:2, 2] = shaped("fc", 2, 1)[:, 0], shaped("cc", 2, 1)[:, 0]
    return torch.stack(
        [
            K @ torch.cat([shaped(f"Rc_{number}", 3, 3), shaped(f"Tc_{number}", 3, 1)], dim=1)
            for number in numbers
        ]
    )
