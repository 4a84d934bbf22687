"""Maps of float32 as OpenEXR files: scan lines in one part, packed without loss."""

import struct
import zlib
from pathlib import Path

import numpy as np

_START = b"\x76\x2f\x31\x01" + struct.pack("<I", 2)  # magic number, version
_ZIP, _LINES = 3, 16  # method of packing, and how many lines it packs together
_FLOAT = 2
_NAMES = {1: ("Y",), 3: ("R", "G", "B")}


def write_exr(values: np.ndarray, path: Path | str, comment: str = "") -> None:
    """Write one map or three, ``height width channel``, under the names Y, or R, G and B.

    Args:
        comment: What the values mean; kept in the header under ``comments``.
    """
    height, width, count = values.shape
    channels = sorted(zip(_NAMES[count], range(count), strict=True))
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    listed = b"".join(
        name.encode() + struct.pack("<BIIII", 0, _FLOAT, 0, 1, 1) for name, _ in channels
    )
    header = _START
    for name, kind, data in (
        ("channels", "chlist", listed + b"\0"),
        ("comments", "string", comment.encode()),
        ("compression", "compression", bytes([_ZIP])),
        ("dataWindow", "box2i", window),
        ("displayWindow", "box2i", window),
        ("lineOrder", "lineOrder", b"\0"),
        ("pixelAspectRatio", "float", struct.pack("<f", 1)),
        ("screenWindowCenter", "v2f", struct.pack("<2f", 0, 0)),
        ("screenWindowWidth", "float", struct.pack("<f", 1)),
    ):
        header += f"{name}\0{kind}\0".encode() + struct.pack("<I", len(data)) + data
    header += b"\0"
    # In a line, one channel lies after the other.
    lines = values[..., [index for _, index in channels]].transpose(0, 2, 1).astype("<f4")
    blocks = [
        struct.pack("<i", first) + _packed(lines[first : first + _LINES].tobytes())
        for first in range(0, height, _LINES)
    ]
    at = len(header) + 8 * len(blocks)
    table = np.cumsum([at, *(len(block) for block in blocks[:-1])]).astype("<u8")
    Path(path).write_bytes(header + table.tobytes() + b"".join(blocks))


def _packed(raw: bytes) -> bytes:
    """Pack a block, its size before it: of every other byte the differences, then of the rest."""
    plain = np.frombuffer(raw, np.uint8)
    halves = np.concatenate([plain[::2], plain[1::2]])
    halves[1:] = np.diff(halves) + np.uint8(128)
    data = zlib.compress(halves.tobytes())
    data = raw if len(data) >= len(raw) else data  # readers tell by the size
    return struct.pack("<I", len(data)) + data
