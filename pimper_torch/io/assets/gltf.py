"""Binary glTF."""

import json
import struct
from collections.abc import Collection, Mapping, Sequence
from io import BytesIO
from typing import Any

import numpy as np
from PIL import Image

from pimper_torch.geometry.local_frame import NO_OFFSET, Offset
from pimper_torch.io.assets.placement import Placement

_ARRAYS, _INDICES = 34962, 34963  # targets of buffer views
_TRIANGLES, _POINTS = 4, 0
_KINDS = {"u1": 5121, "u2": 5123, "u4": 5125, "f4": 5126}
_SHAPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
_LINEAR_MIPMAP_LINEAR, _LINEAR, _CLAMP = 9987, 9729, 33071
_WEBP = "EXT_texture_webp"
# glTF's default is metal.
MATTE: dict[str, Any] = {
    "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0},
    "doubleSided": True,
}
# Replaces normals and tangents of zero length: glTF requires unit vectors.
_UPWARD = (0.0, 0.0, 1.0)


def gltf_of(
    attributes: Mapping[str, np.ndarray],
    faces: np.ndarray,
    material: Mapping[str, Any],
    images: Sequence[bytes] = (),
    offset_world: Offset = NO_OFFSET,
    placement: Placement | None = None,
) -> bytes:
    """Return one mesh with one material as a GLB.

    Args:
        attributes: By glTF's names, one row per vertex; written in single precision.
        faces: Three vertices each. If empty, the vertices are points.
        material: In glTF's terms; its texture indices refer to ``images``. Extensions that it
            names are declared.
        images: PNG, JPEG or WebP files.
        offset_world: The node's ``translation``.
        placement: Gives the name of node, mesh and material, the node's ``extras``, and cameras.
    """
    binary = _Binary()
    positions = np.asarray(attributes["POSITION"], "<f4")
    bounds = {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()}
    primitive: dict[str, Any] = {"attributes": {}, "mode": _TRIANGLES if len(faces) else _POINTS}
    if len(faces):
        kind = "<u2" if len(positions) < 65536 else "<u4"
        primitive["indices"] = binary.add_rows(faces.astype(kind).ravel(), _INDICES)
    for key, values in attributes.items():
        rows = _unit(values) if key in ("NORMAL", "TANGENT") else np.asarray(values, "<f4")
        more = bounds if key == "POSITION" else {}
        primitive["attributes"][key] = binary.add_rows(rows, _ARRAYS, **more)
    primitive["material"] = 0
    cameras = [] if placement is None else placement.gltf_cameras()
    tree: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "pimper_torch"},
        "scene": 0,
        "scenes": [{"nodes": list(range(1 + len(cameras)))}],
        "nodes": [{"mesh": 0}, *({**node, "camera": index} for index, node in enumerate(cameras))],
        "meshes": [{"primitives": [primitive]}],
        "materials": [dict(material)],
        "accessors": binary.accessors,
        "bufferViews": binary.views,
    }
    if offset_world != NO_OFFSET:
        tree["nodes"][0]["translation"] = list(offset_world)
    if placement is not None:
        for kind in ("nodes", "meshes", "materials"):
            tree[kind][0]["name"] = placement.name
        tree["nodes"][0]["extras"] = placement.extras
    if cameras:
        tree["cameras"] = [node["camera"] for node in cameras]
    tree |= _textures(images, binary, material.get("extensions", ()))
    tree["buffers"] = [{"byteLength": len(binary.data)}]
    return glb(tree, binary.data)


class _Binary:
    """The binary chunk of a GLB under construction, with its buffer views and accessors."""

    def __init__(self) -> None:
        self.data, self.views, self.accessors = bytearray(), list[Any](), list[Any]()

    def add(self, data: bytes, **target: int) -> int:
        """Append a buffer view; return its index."""
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data)}
        self.views.append({**view, **target})
        self.data.extend(data + bytes(-len(data) % 4))
        return len(self.views) - 1

    def add_rows(self, values: np.ndarray, target: int, **more: object) -> int:
        """Append an array as buffer view and accessor; return the accessor's index."""
        rows = np.ascontiguousarray(values)
        accessor = {
            "bufferView": self.add(rows.tobytes(), target=target),
            "componentType": _KINDS[rows.dtype.str[1:]],
            "count": len(rows),
            "type": _SHAPES[1 if rows.ndim == 1 else rows.shape[1]],
        }
        self.accessors.append({**accessor, **more})
        return len(self.accessors) - 1


def _textures(images: Sequence[bytes], binary: _Binary, used: Collection[str]) -> dict[str, Any]:
    """Return a texture per image, and the declarations of all ``used`` and needed extensions."""
    tree: dict[str, Any] = {}
    if images:
        kinds = [Image.open(BytesIO(image)).get_format_mimetype() for image in images]
        tree["images"] = [
            {"bufferView": binary.add(image), "mimeType": kind}
            for image, kind in zip(images, kinds, strict=True)
        ]
        sampler = {"magFilter": _LINEAR, "minFilter": _LINEAR_MIPMAP_LINEAR}
        tree["samplers"] = [{**sampler, "wrapS": _CLAMP, "wrapT": _CLAMP}]
        tree["textures"] = [
            {"sampler": 0, "extensions": {_WEBP: {"source": index}}}
            if kind == "image/webp"
            else {"source": index, "sampler": 0}
            for index, kind in enumerate(kinds)
        ]
        if "image/webp" in kinds:
            used = {*used, _WEBP}
            tree["extensionsRequired"] = [_WEBP]
    return tree | ({"extensionsUsed": sorted(used)} if used else {})


def glb(tree: Mapping[str, Any], binary: bytes | bytearray) -> bytes:
    """Return a GLB of glTF's JSON and a binary chunk."""
    text = json.dumps(tree, separators=(",", ":"), allow_nan=False).encode("ascii")
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4s2I", b"glTF", 2, 28 + len(text) + len(binary))
    head += struct.pack("<I4s", len(text), b"JSON") + text
    return head + struct.pack("<I4s", len(binary), b"BIN\0") + binary


def _unit(values: np.ndarray) -> np.ndarray:
    """Normalize the first three columns, in single precision."""
    rows = np.array(values, "<f8")
    length = np.linalg.norm(rows[:, :3], axis=1, keepdims=True)
    rows[:, :3] = np.where(length > 0, rows[:, :3] / np.where(length > 0, length, 1), _UPWARD)
    return rows.astype("<f4")
