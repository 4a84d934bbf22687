"""Contents of mesh files that trimesh misreads."""

import json
import re
import struct
from pathlib import Path

from pimper_torch.errors import InputError

# glTF's name for vertex colours, and one that trimesh takes over as it stands in the file: those of
# the first it rounds to 8 bits, or cuts to them.
COLORS, RAW_COLORS = "COLOR_0", "_COLOR_0"


def readable(path: Path, suffix: str) -> bytes:
    """Return a file's bytes so that trimesh reads all that they hold.

    Args:
        suffix: Of its name, lower case.

    Raises:
        InputError: It is cut short, or has values that trimesh passes over.
    """
    data = path.read_bytes()
    if suffix == ".glb":
        return _with_raw_colors(path, data)
    header, _, body = data.partition(b"end_header")
    if suffix == ".ply" and b"format ascii" in header:
        counts = re.findall(rb"^element \S+ (\d+)", header, re.MULTILINE)
        told, rows = sum(map(int, counts)), len(body.strip().splitlines())
        if told > rows:
            raise InputError(
                f"{path}: cannot be read as a mesh, it says that it holds {told} rows, but has "
                f"{rows}. Export it again."
            )
    return data


def _with_raw_colors(path: Path, data: bytes) -> bytes:
    """Rename the colours of surfaces in a GLB file; trimesh reads no other attributes of points."""
    length, size = struct.unpack_from("<2I", data, 8)
    tree = json.loads(data[20 : 20 + size])
    if any("sparse" in one or "bufferView" not in one for one in tree.get("accessors", [])):
        raise InputError(
            f"{path}: cannot be read as a mesh, it has values that are not in the file itself "
            "(sparse, or compressed). Export it without compression."
        )
    for mesh in tree.get("meshes", []):
        for part in mesh["primitives"]:
            if COLORS in part["attributes"] and part.get("mode") != 0:
                part["attributes"][RAW_COLORS] = part["attributes"].pop(COLORS)
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    sizes = struct.pack("<2I", length - size + len(text), len(text))
    return data[:8] + sizes + data[16:20] + text + data[20 + size :]
