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
    """Write 16-bit PNG of 1 to 4 channels, which Pillow cannot."""

    def write(path: Path, array: np.ndarray) -> None:
        kind = {1: 0, 2: 4, 3: 2, 4: 6}[1 if array.ndim == 2 else array.shape[2]]
        height, width = array.shape[:2]
        rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in array)
        header = struct.pack(">IIBBBBB", width, height, 16, kind, 0, 0, 0)
        path.write_bytes(
            b"\x89PNG\r\n\x1a\n"
            + _chunk(b"IHDR", header)
            + _chunk(b"IDAT", zlib.compress(rows))
            + _chunk(b"IEND", b"")
        )

    return write


@pytest.fixture
def write_packbits_tiff():
    """Write 16-bit RGB TIFF with PackBits, which tifffile alone cannot read."""

    def write(path: Path, array: np.ndarray, orientation: int = 1) -> None:
        height, width = array.shape[:2]
        data = b""
        for row in array:
            raw = row.astype("<u2").tobytes()
            for start in range(0, len(raw), 128):
                piece = raw[start : start + 128]
                data += bytes([len(piece) - 1]) + piece
        long_entries = {256: width, 257: height, 278: height, 279: len(data), 273: 8}
        short_entries = {259: 32773, 262: 2, 274: orientation, 277: 3, 284: 1}
        bits_at = 8 + len(data)
        entries = [(tag, 4, 1, value) for tag, value in long_entries.items()]
        entries += [(tag, 3, 1, value) for tag, value in short_entries.items()]
        entries += [(258, 3, 3, bits_at)]
        directory = struct.pack("<H", len(entries))
        directory += b"".join(struct.pack("<HHII", *entry) for entry in sorted(entries))
        header = b"II*\0" + struct.pack("<I", bits_at + 6)
        path.write_bytes(header + data + struct.pack("<HHH", 16, 16, 16) + directory + bytes(4))

    return write


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
