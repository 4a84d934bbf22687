"""Maps as OpenEXR files: scan lines in one part, losslessly compressed."""

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

_START = b"\x76\x2f\x31\x01" + struct.pack("<I", 2)  # magic number, version
_ZIP, _LINES = 3, 16  # compression method, and number of lines in a block
_LINES_OF = {0: 1, 2: 1, _ZIP: _LINES}  # for all supported methods: none, ZIPS and ZIP
_KINDS = {0: "<u4", 1: "<f2", 2: "<f4"}
_NAMES = {1: ("Y",), 3: ("R", "G", "B")}


def write_exr(values: np.ndarray, path: Path | str, comment: str = "") -> None:
    """Write a map ``height width channel`` as channel Y, or channels R, G and B.

    Args:
        comment: Meaning of the values, written to ``comments`` in the header.
    """
    height, width, count = values.shape
    channels = sorted(zip(_NAMES[count], range(count), strict=True))
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    chlist = b"".join(name.encode() + struct.pack("<BIIII", 0, 2, 0, 1, 1) for name, _ in channels)
    header = _START
    for name, kind, data in (
        ("channels", "chlist", chlist + b"\0"),
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
    # A line stores its channels one after the other.
    lines = values[..., [index for _, index in channels]].transpose(0, 2, 1).astype("<f4")
    blocks = [
        struct.pack("<i", first) + _packed(lines[first : first + _LINES].tobytes())
        for first in range(0, height, _LINES)
    ]
    start = len(header) + 8 * len(blocks)
    table = np.cumsum([start, *(len(block) for block in blocks[:-1])]).astype("<u8")
    Path(path).write_bytes(header + table.tobytes() + b"".join(blocks))


def read_exr(path: Path | str, max_samples: int) -> dict[str, np.ndarray]:
    """Read the channels of an image with scan lines in one part, ``height width`` in float32.

    Args:
        max_samples: An image with more samples is a ``ValueError``, as is a damaged file.
    """
    data = Path(path).read_bytes()
    try:
        return _channels(data, max_samples)
    except (struct.error, IndexError, KeyError, OverflowError, zlib.error) as error:
        raise ValueError("it is cut short or damaged") from error


def _channels(data: bytes, max_samples: int) -> dict[str, np.ndarray]:
    if data[:4] != _START[:4]:
        raise ValueError("it is not an OpenEXR file")
    if struct.unpack_from("<I", data, 4)[0] & 0x1A00:
        raise ValueError("it has tiles or several parts; needed: scan lines in one part")
    header, offset = {}, 8
    while data[offset] != 0:
        # Names have at most 255 bytes.
        name, kind, rest, *_ = (*data[offset : offset + 600].split(b"\0", 2), b"", b"")
        (size,) = struct.unpack_from("<I", rest)
        offset += len(name) + len(kind) + 6
        header[name] = data[offset : offset + size]
        offset += size
    packing = header[b"compression"][0]
    if packing not in _LINES_OF:
        raise ValueError("its compression is not ZIP; save it with ZIP or without compression")
    left, top, right, bottom = struct.unpack("<4i", header[b"dataWindow"])
    width, height, lines = right - left + 1, bottom - top + 1, _LINES_OF[packing]
    channels = dict(_listed(header[b"channels"]))
    if not (width > 0 and height > 0 and 0 < width * height * len(channels) <= max_samples):
        raise ValueError(f"its header states {width} x {height} pixels of {len(channels)} channels")
    row = np.dtype([(name, kind, (width,)) for name, kind in channels.items()])
    blocks = -(-height // lines)
    rows: list[np.ndarray] = []
    for start in struct.unpack_from(f"<{blocks}Q", data, offset + 1):
        count = min(lines, height - len(rows) * lines)
        (size,) = struct.unpack_from("<I", data, start + 4)
        packed = data[start + 8 : start + 8 + size]
        raw = packed if size == count * row.itemsize else _unpacked(packed, count * row.itemsize)
        if len(raw) != count * row.itemsize:
            raise IndexError
        rows.append(np.frombuffer(raw, row))
    samples = np.concatenate(rows)
    return {name: samples[name].astype(np.float32) for name in channels}


def _listed(channels: bytes) -> Iterator[tuple[str, str]]:
    """List names and types of channels, in their order within a line."""
    while channels[0] != 0:
        name, _, rest = channels.partition(b"\0")
        kind, _, *steps = struct.unpack_from("<IIII", rest)
        if steps != [1, 1]:
            raise ValueError("it has subsampled channels; needed: one value per pixel")
        yield name.decode("utf-8", "replace"), _KINDS[kind]
        channels = rest[16:]


def _unpacked(packed: bytes, size: int) -> bytes:
    """Undo :func:`_packed` of a block of ``size`` bytes."""
    halves = np.frombuffer(zlib.decompressobj().decompress(packed, size), np.uint8).copy()
    halves[1:] -= np.uint8(128)
    halves = np.cumsum(halves, dtype=np.uint8)
    plain = np.empty_like(halves)
    middle = (len(halves) + 1) // 2
    plain[::2], plain[1::2] = halves[:middle], halves[middle:]
    return plain.tobytes()


def _packed(raw: bytes) -> bytes:
    """Compress a block, preceded by its size: differences of even bytes, then of odd bytes."""
    plain = np.frombuffer(raw, np.uint8)
    halves = np.concatenate([plain[::2], plain[1::2]])
    halves[1:] = np.diff(halves) + np.uint8(128)
    data = zlib.compress(halves.tobytes())
    data = raw if len(data) >= len(raw) else data  # readers detect this by the size
    return struct.pack("<I", len(data)) + data
