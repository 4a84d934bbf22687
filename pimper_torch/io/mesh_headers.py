"""Checks of mesh files' headers: sizes that a parser would allocate, and values it would misread.

Counts of binary PLY and of glTF's views beyond the file are refused by trimesh itself.
"""

import json
import re
import struct
from typing import Any, TypeAlias

# A choice: a scene may place its meshes several times, and each takes memory.
_MAX_PLACED = 100_000_000


# What JSON holds.
_Tree: TypeAlias = dict[str, Any]


def impossible(data: bytes, suffix: str) -> str:
    """State what a PLY, STL or GLB file cannot hold; nothing where all is possible.

    Args:
        suffix: Of its name, lower case.
    """
    try:
        if suffix == ".ply":
            return _impossible_ply(data)
        if suffix == ".stl":
            return _impossible_stl(data)
        return _impossible_glb(data) if suffix == ".glb" else ""
    except (ValueError, KeyError, TypeError, IndexError, AttributeError, struct.error):
        return "its header is damaged"
    except RecursionError:
        return "its header is nested too deeply"


# glTF's name for vertex colours, and one that trimesh takes over as it stands in the file: those of
# the first it rounds to 8 bits, or cuts to them.
COLORS, RAW_COLORS = "COLOR_0", "_COLOR_0"


def with_raw_colors(data: bytes) -> bytes:
    """Rename the colours of surfaces in a GLB file; trimesh reads no other attributes of points."""
    length, size = struct.unpack_from("<2I", data, 8)
    tree = json.loads(data[20 : 20 + size])
    for mesh in tree.get("meshes", []):
        for part in mesh["primitives"]:
            if COLORS in part["attributes"] and part.get("mode") != 0:
                part["attributes"][RAW_COLORS] = part["attributes"].pop(COLORS)
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    sizes = struct.pack("<2I", length - size + len(text), len(text))
    return data[:8] + sizes + data[16:20] + text + data[20 + size :]


def _impossible_ply(data: bytes) -> str:
    """Compare counts with the rows of a text; of a binary file, with its bytes."""
    header, _, body = data.partition(b"end_header")
    counts = [int(count) for count in re.findall(rb"^element \S+ (-?\d+)", header, re.MULTILINE)]
    rows = len(body.strip().splitlines()) if b"format ascii" in header else len(body)
    count = min([0, *counts]) or sum(counts)
    return _more(count, "rows", rows) if not 0 <= count <= rows else ""


def _impossible_stl(data: bytes) -> str:
    if len(data) < 84 or data.lstrip()[:5].lower() == b"solid":
        return ""  # text, or for the parser to refuse
    (count,) = struct.unpack_from("<I", data, 80)
    return "" if 84 + 50 * count <= len(data) else _more(84 + 50 * count, "bytes", len(data))


def _impossible_glb(data: bytes) -> str:
    magic, _, length = struct.unpack_from("<4s2I", data)
    size, kind = struct.unpack_from("<I4s", data, 12)
    if magic != b"glTF" or kind != b"JSON" or length > len(data) or size > len(data) - 20:
        return "it has no header of a GLB, or is cut short"
    tree = json.loads(data[20 : 20 + size])
    accessors = _section(tree, "accessors")
    if any("sparse" in one or "bufferView" not in one for one in accessors):
        return "it has values that are not in the file itself (sparse, or compressed)"
    return _impossible_tree(tree, accessors)


def _impossible_tree(tree: _Tree, accessors: list[_Tree]) -> str:
    """State why a scene's tree is none, or too much."""
    nodes, meshes = _section(tree, "nodes"), _section(tree, "meshes")
    children = [_whole(child) for node in nodes for child in _list(node.get("children", []))]
    if len(set(children)) < len(children) or any(child >= len(nodes) for child in children):
        return "a node of its scene stands in two places, or in none"
    reached, stack = 0, [index for index in range(len(nodes)) if index not in set(children)]
    while stack:
        reached += 1
        stack += [_whole(child) for child in _list(nodes[stack.pop()].get("children", []))]
    if reached < len(nodes):
        return "its scene is a circle of nodes"
    sizes = [
        sum(
            _whole(accessors[_whole(part["attributes"]["POSITION"])]["count"])
            for part in _section(mesh, "primitives")
        )
        for mesh in meshes
    ]
    placed = sum(sizes[_whole(node["mesh"])] for node in nodes if "mesh" in node)
    return "" if placed <= _MAX_PLACED else f"its scene has {placed} vertices"


def _section(tree: _Tree, name: str) -> list[_Tree]:
    found = _list(tree.get(name, []))
    if not all(isinstance(one, dict) for one in found):
        raise ValueError(name)
    return found


def _list(value: object) -> list[Any]:
    if not isinstance(value, list):
        raise TypeError("no list")
    return value


def _whole(value: object) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        raise ValueError(f"{value} is no count")
    return value


def _more(needed: int, unit: str, held: int) -> str:
    return f"it says that it holds {needed} {unit}, but has {held}"
