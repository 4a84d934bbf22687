"""What mesh files say that they hold, against how long they are: before a parser takes memory."""

import json
import struct
from typing import Any, TypeAlias

# Bytes of PLY's types and of glTF's components; components of glTF's elements.
_PLY = {
    "char": 1,
    "uchar": 1,
    "short": 2,
    "ushort": 2,
    "int": 4,
    "uint": 4,
    "float": 4,
    "double": 8,
}
_PLY |= {"int8": 1, "uint8": 1, "int16": 2, "uint16": 2, "int32": 4, "uint32": 4}
_PLY |= {"float32": 4, "float64": 8, "double": 8, "int64": 8, "uint64": 8}
_GLTF = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
_ELEMENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_MAX_HEADER = 100_000
# A choice: a scene may place its meshes several times, and each takes memory.
_MAX_PLACED = 100_000_000


# What JSON holds.
_Tree: TypeAlias = dict[str, Any]


def impossible(data: bytes, suffix: str) -> str:
    """Say what a PLY, STL or GLB file cannot hold; nothing where all is possible.

    Args:
        data: The file.
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


def _impossible_ply(data: bytes) -> str:
    end = data.find(b"end_header", 0, _MAX_HEADER)
    if not data.startswith(b"ply") or end < 0:
        return "it has no header of a PLY"
    body = len(data) - (data.find(b"\n", end) + 1 or len(data))
    text = b"format ascii" in data[:end]
    needed, count, row = 0, 0, 0
    for line in [*data[:end].decode("latin-1").splitlines(), "element end 0"]:
        words = line.split()
        if words[:1] == ["element"]:
            needed += count * max(row, 1)
            count, row = int(words[2]), 0
            if count < 0:
                return f"it says that it holds {count} of {words[1]}"
        elif words[:1] == ["property"]:
            row += 2 if text else _PLY[words[2] if words[1] == "list" else words[1]]
    # In a text, the last number of the file may have no space behind it.
    return "" if needed <= body + text else _more(needed, body)


def _impossible_stl(data: bytes) -> str:
    if len(data) < 84 or data.lstrip()[:5].lower() == b"solid":
        return ""  # text, or for the parser to refuse
    (count,) = struct.unpack_from("<I", data, 80)
    return "" if 84 + 50 * count <= len(data) else _more(84 + 50 * count, len(data))


def _impossible_glb(data: bytes) -> str:
    magic, _, length = struct.unpack_from("<4s2I", data)
    size, kind = struct.unpack_from("<I4s", data, 12)
    if magic != b"glTF" or kind != b"JSON" or length > len(data) or size > len(data) - 20:
        return "it has no header of a GLB, or is cut short"
    tree = json.loads(data[20 : 20 + size])
    binary = max(0, len(data) - 28 - size)
    views = _section(tree, "bufferViews")
    for view in views:
        start, held = _whole(view.get("byteOffset", 0)), _whole(view["byteLength"])
        if start + held > binary:
            return _more(start + held, binary)
    accessors = _section(tree, "accessors")
    for accessor in accessors:
        if "sparse" in accessor or "bufferView" not in accessor:
            return "it has values that are not in the file itself (sparse, or compressed)"
        view = views[_whole(accessor["bufferView"])]
        unit = _GLTF[accessor["componentType"]] * _ELEMENTS[accessor["type"]]
        start = _whole(accessor.get("byteOffset", 0))
        needed, stride = _whole(accessor["count"]), _whole(view.get("byteStride", unit))
        needed = start + (unit + (needed - 1) * max(stride, unit) if needed else 0)
        if needed > _whole(view["byteLength"]):
            return _more(needed, view["byteLength"])
    return _impossible_tree(tree, accessors)


def _impossible_tree(tree: _Tree, accessors: list[_Tree]) -> str:
    """Say why a scene's tree is none, or too much."""
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


def _more(needed: int, held: object) -> str:
    return f"it says that it holds {needed} bytes, but has {held}"
