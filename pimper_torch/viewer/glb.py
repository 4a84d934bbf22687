"""A coloured surface as binary glTF, in memory."""

import json

import numpy as np
from jaxtyping import Float, Int
from torch import Tensor

_FLOAT, _SHORT, _INT = 5126, 5123, 5125  # glTF's numbers of types
_VERTICES, _CORNERS = 34_962, 34_963  # of what a buffer is for


def glb_of(
    vertices: Float[Tensor, "vertex 3"],
    normals: Float[Tensor, "vertex 3"],
    colors: Float[Tensor, "vertex 3"],
    faces: Int[Tensor, "face 3"],
    *,
    lit: bool,
) -> bytes:
    """Write a matte surface whose colours have 16 bits.

    Args:
        colors: Linear, in [0, 1].
        lit: Whether light shades it.
    """
    shorts = np.full((len(colors), 4), 65_535, dtype="<u2")
    shorts[:, :3] = np.rint(65_535 * colors.numpy())
    columns = {
        "POSITION": (vertices.numpy().astype("<f4"), _FLOAT, "VEC3", _VERTICES),
        "NORMAL": (normals.numpy().astype("<f4"), _FLOAT, "VEC3", _VERTICES),
        "COLOR_0": (shorts, _SHORT, "VEC4", _VERTICES),
        "": (faces.numpy().astype("<u4").reshape(-1, 1), _INT, "SCALAR", _CORNERS),
    }
    views: list[dict[str, object]] = []
    accessors: list[dict[str, object]] = []
    offset = 0
    for values, kind, shape, target in columns.values():
        span = {"buffer": 0, "byteOffset": offset, "byteLength": values.nbytes}
        views.append({**span, "target": target})
        offset += values.nbytes
        about = {"bufferView": len(accessors), "componentType": kind, "count": len(values)}
        accessors.append({**about, "type": shape, "normalized": kind == _SHORT})
    positions = columns["POSITION"][0]
    accessors[0] |= {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()}
    names = [name for name in columns if name]
    matte = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    material: dict[str, object] = {"pbrMetallicRoughness": matte, "doubleSided": True}
    if not lit:
        material["extensions"] = {"KHR_materials_unlit": {}}
    primitive = {"attributes": {name: place for place, name in enumerate(names)}}
    tree = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{**primitive, "indices": len(names), "material": 0}]}],
        "materials": [material],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
        "extensionsUsed": [] if lit else ["KHR_materials_unlit"],
    }
    text = json.dumps({key: one for key, one in tree.items() if one != []}).encode("ascii")
    text += b" " * (-len(text) % 4)
    data = b"".join(values.tobytes() for values, *_ in columns.values())
    head = np.array([0x46546C67, 2, 28 + len(text) + len(data), len(text), 0x4E4F534A], dtype="<u4")
    middle = np.array([len(data), 0x004E4942], dtype="<u4")
    return head.tobytes() + text + middle.tobytes() + data
