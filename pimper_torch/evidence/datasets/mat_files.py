"""MATLAB's files of version 5 to 7, read without memory that they have no room for.

SciPy's reader ends the process on some damaged files.

Source: MathWorks, MAT-File Format, "MAT-File Level 5".
"""

import math
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np

# Numbers by their type in the file, and classes of arrays that hold numbers.
_KINDS = {
    1: "i1",
    2: "u1",
    3: "i2",
    4: "u2",
    5: "i4",
    6: "u4",
    7: "f4",
    9: "f8",
    12: "i8",
    13: "u8",
}
_CLASSES = {6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4"}
_CLASSES |= {14: "i8", 15: "u8"}
_MATRIX, _COMPRESSED, _COMPLEX = 14, 15, 0x0800
# A choice: the largest array of the published sets has 0.1 GB.
MAX_BYTES = 2**29


def read_variables(
    path: Path | str, wanted: Callable[[str], bool] = lambda name: True
) -> dict[str, np.ndarray | None]:
    """Read the arrays of real numbers whose names are wanted; ``None`` for other variables.

    Raises:
        ValueError: It is no such file, is cut short, or unpacks to more than 512 MB: says which.
    """
    data = Path(path).read_bytes()
    if len(data) < 128 or data[126:128] not in (b"IM", b"MI"):
        raise ValueError("it is no MATLAB file of version 5 to 7")
    order = "<" if data[126:128] == b"IM" else ">"
    if struct.unpack_from(f"{order}H", data, 124)[0] != 0x0100:
        raise ValueError("its version is 7.3 or unknown")
    found: dict[str, np.ndarray | None] = {}
    at, room = 128, MAX_BYTES
    while at + 8 <= len(data):
        kind, size = struct.unpack_from(f"{order}2I", data, at)
        body = data[at + 8 : at + 8 + size]
        if len(body) < size:
            raise ValueError("it is cut short")
        at += 8 + size
        if kind == _COMPRESSED:
            body = _unpacked(body, room)
            room -= len(body)
            kind, size = struct.unpack_from(f"{order}2I", body) if len(body) >= 8 else (0, 0)
            body = body[8 : 8 + size]
        if kind == _MATRIX:
            name, array = _variable(body, order, wanted)
            found[name] = array
    return found


def _unpacked(body: bytes, room: int) -> bytes:
    try:
        unpacker = zlib.decompressobj()
        unpacked = unpacker.decompress(body, max(room, 1))
    except zlib.error as error:
        raise ValueError("what is compressed in it is damaged") from error
    if not unpacker.eof and (unpacker.unconsumed_tail or len(unpacked) >= room):
        raise ValueError(f"its arrays would take more than {MAX_BYTES} bytes")
    return unpacked


def _variable(
    body: bytes, order: str, wanted: Callable[[str], bool]
) -> tuple[str, np.ndarray | None]:
    _, flags, at = _element(body, 0, order)
    if len(flags) < 8:
        raise ValueError("a variable has no class")
    (flag,) = struct.unpack_from(f"{order}I", flags)
    _, sides, at = _element(body, at, order)
    shape = np.frombuffer(sides[: len(sides) // 4 * 4], f"{order}i4").tolist()
    _, name, at = _element(body, at, order)
    text = name.decode("latin-1")
    if flag & 0xFF not in _CLASSES or flag & _COMPLEX or not wanted(text):
        return text, None
    kind, values, _ = _element(body, at, order)
    if kind not in _KINDS or not 2 <= len(shape) <= 8 or any(side < 0 for side in shape):
        raise ValueError(f"{text[:40]!r} has no type or shape")
    packed = np.dtype(f"{order}{_KINDS[kind]}")
    if math.prod(shape) * packed.itemsize != len(values):
        raise ValueError(
            f"{text[:40]!r} says that its shape is {shape}, and has {len(values)} bytes"
        )
    array = np.frombuffer(values, packed).astype(_CLASSES[flag & 0xFF])
    return text, array.reshape(shape, order="F")


def _element(body: bytes, at: int, order: str) -> tuple[int, bytes, int]:
    """Return type and bytes of an element, short ones in their tag, and where the next begins."""
    if at + 8 > len(body):
        raise ValueError("a variable is cut short")
    (word,) = struct.unpack_from(f"{order}I", body, at)
    if word >> 16:
        size = word >> 16
        if size > 4:
            raise ValueError("a variable has a tag that is none")
        return word & 0xFFFF, body[at + 4 : at + 4 + size], at + 8
    (size,) = struct.unpack_from(f"{order}I", body, at + 4)
    if size > len(body) - at - 8:
        raise ValueError("a variable is cut short")
    return word, body[at + 8 : at + 8 + size], at + 8 + size + -size % 8
