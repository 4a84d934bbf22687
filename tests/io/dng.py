"""A minimal DNG, as cameras and converters write it: one directory, one strip, and EXIF."""

import struct
from collections.abc import Iterable
from pathlib import Path

import numpy as np

# Of some camera, from XYZ to its colours under D65.
XYZ_TO_CAMERA = (
    (0.6722, -0.0635, -0.0963),
    (-0.4287, 1.2460, 0.2028),
    (-0.0908, 0.2162, 0.5668),
)
BAYER = np.array([[0, 1], [1, 2]])
_SIZE = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 10: 8}  # bytes of TIFF's types


def write_dng(
    path: Path,
    mosaic: np.ndarray,
    *,
    black: int = 256,
    white: int = 4000,
    neutral: tuple[float, float, float] = (0.5, 1.0, 0.7),
    orientation: int = 1,
    equivalent: int | None = None,
    size: tuple[int, int] | None = None,
    pattern: np.ndarray = BAYER,
    active: tuple[int, int, int, int] | None = None,
    crop: tuple[int, int, int, int] | None = None,
) -> None:
    """Write a mosaic of red, green; green, blue, or of another pattern, or all colours a pixel.

    ``size`` is what the header claims in place of the mosaic's width and height, ``active`` the
    top, left, bottom and right of what sees light, and ``crop`` the left, top, width and height in
    it of what cameras and converters show.
    """
    height, width = mosaic.shape[:2]
    samples = 1 if mosaic.ndim == 2 else mosaic.shape[2]
    width, height = size or (width, height)
    data = mosaic.astype("<u2").tobytes()
    tags = {
        254: (4, [0]),
        256: (4, [width]),
        257: (4, [height]),
        258: (3, [16] * samples),
        259: (3, [1]),
        262: (3, [32803 if samples == 1 else 34892]),
        271: (2, b"Test\0"),
        272: (2, b"Camera\0"),
        273: (4, [8]),
        274: (3, [orientation]),
        277: (3, [samples]),
        278: (4, [height]),
        279: (4, [len(data)]),
        33421: (3, list(pattern.shape)),
        33422: (1, bytes(pattern.ravel().tolist())),
        50706: (1, bytes([1, 4, 0, 0])),
        50707: (1, bytes([1, 1, 0, 0])),
        50708: (2, b"Test Camera\0"),
        50714: (3, [black] * samples),
        50717: (3, [white] * samples),
        50721: (10, _ratios(one for row in XYZ_TO_CAMERA for one in row)),
        50728: (5, _ratios(neutral)),
        50778: (3, [21]),
    }
    tags |= {} if active is None else {50829: (4, list(active))}
    tags |= {} if crop is None else {50719: (4, list(crop[:2])), 50720: (4, list(crop[2:]))}
    exif = {} if equivalent is None else {0xA405: (3, [equivalent])}
    at = 8 + len(data)
    tags[34665] = (4, [at])
    body = _directory(exif, at)
    first = at + len(body)
    body += _directory(tags, first)
    path.write_bytes(b"II*\0" + struct.pack("<I", first) + data + body)


def _ratios(values: Iterable[float]) -> list[int]:
    return [part for value in values for part in (round(10000 * value), 10000)]


def _directory(tags: dict[int, tuple[int, list[int] | bytes]], at: int) -> bytes:
    entries, rest = b"", b""
    start = at + 2 + 12 * len(tags) + 4
    for tag, (kind, values) in sorted(tags.items()):
        packed = values if isinstance(values, bytes) else _packed(kind, values)
        count = len(packed) // _SIZE[kind]
        where = packed.ljust(4, b"\0")
        if len(packed) > 4:
            where = struct.pack("<I", start + len(rest))
            rest += packed + bytes(len(packed) % 2)
        entries += struct.pack("<HHI", tag, kind, count) + where
    return struct.pack("<H", len(tags)) + entries + bytes(4) + rest


def _packed(kind: int, values: list[int]) -> bytes:
    letter = {3: "H", 4: "I", 5: "I", 10: "i"}[kind]
    return struct.pack(f"<{len(values)}{letter}", *values)
