import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image


@pytest.fixture
def pixels():
    """Random 8-bit RGB, 12 wide and 8 high."""
    return np.random.default_rng(72).integers(0, 256, (8, 12, 3), dtype=np.uint8)


@pytest.fixture
def photos(tmp_path, pixels):
    """A folder of three small photographs."""
    folder = tmp_path / "photos"
    folder.mkdir()
    for number in (1, 2, 10):
        Image.fromarray(pixels).save(folder / f"{number}.png")
    return folder


@pytest.fixture
def write_png16():
    """Write 16-bit PNG of 1 to 4 channels, which Pillow cannot, with chunks before its pixels."""

    def write(path: Path, array: np.ndarray, **chunks: bytes) -> None:
        kind = {1: 0, 2: 4, 3: 2, 4: 6}[1 if array.ndim == 2 else array.shape[2]]
        height, width = array.shape[:2]
        rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in array)
        header = struct.pack(">IIBBBBB", width, height, 16, kind, 0, 0, 0)
        path.write_bytes(
            b"\x89PNG\r\n\x1a\n"
            + _chunk(b"IHDR", header)
            + b"".join(_chunk(name.encode(), data) for name, data in chunks.items())
            + _chunk(b"IDAT", zlib.compress(rows))
            + _chunk(b"IEND", b"")
        )

    return write


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def s15(*values):
    """Encode numbers as s15Fixed16, as in ICC profiles."""
    return b"".join(struct.pack(">i", round(65536 * value)) for value in values)


@pytest.fixture
def make_profile():
    """Make ICC profiles: a curve as bytes for all colours, and primaries as columns."""

    def make(curve, columns=None, name="test", space=b"RGB ", connection=b"XYZ ", more=None):
        colours = b"rgb" if space == b"RGB " else b"k"
        curves = (curve,) * len(colours) if isinstance(curve, bytes) else curve
        tags = {bytes([one]) + b"TRC": each for one, each in zip(colours, curves, strict=True)}
        for one, column in zip(b"rgb", columns or (), strict=False):
            tags[bytes([one]) + b"XYZ"] = b"XYZ " + bytes(4) + s15(*column)
        text = name.encode() + b"\0"
        tags[b"desc"] = b"desc" + bytes(4) + struct.pack(">I", len(text)) + text + bytes(78)
        tags |= more or {}
        tags[b"wtpt"] = b"XYZ " + bytes(4) + s15(0.9642, 1, 0.8249)
        head = bytearray(128)
        head[8:12], head[12:24], head[36:40] = b"\2\x40\0\0", b"mntr" + space + connection, b"acsp"
        head[68:80] = s15(0.9642, 1, 0.8249)
        start, entries, body = 132 + 12 * len(tags), b"", b""
        for tag, data in tags.items():
            entries += struct.pack(">4sII", tag, start + len(body), len(data))
            body += data + bytes(-len(data) % 4)
        head[:4] = struct.pack(">I", start + len(body))
        return bytes(head) + struct.pack(">I", len(tags)) + entries + body

    return make


@pytest.fixture
def png_with():
    """Write 8-bit RGB PNG with chunks before its pixels."""

    def write(path: Path, array: np.ndarray, **chunks: bytes) -> None:
        Image.fromarray(array).save(path)
        data = path.read_bytes()
        extra = b"".join(_chunk(name.encode(), data) for name, data in chunks.items())
        path.write_bytes(data[:33] + extra + data[33:])

    return write
