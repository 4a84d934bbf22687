"""Reading and writing of mesh files."""

import json
import re
import struct
from collections.abc import Callable, Sequence
from io import BytesIO
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING, Any

import lazy_loader
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.geometry.local_frame import NO_OFFSET, Offset
from pimper_torch.geometry.rigid import rotate, transform
from pimper_torch.geometry.surfaces import carried_normals, unit_face_normals
from pimper_torch.geometry.topology import corners_of
from pimper_torch.io.assets.gltf import MATTE, glb, gltf_of
from pimper_torch.io.assets.placement import Placement
from pimper_torch.radiometry import linear_from_srgb, srgb_from_linear, to_bytes
from pimper_torch.radiometry.base_color import base_color
from pimper_torch.records import Mesh
from pimper_torch.records.shapes import FaceMask, Vertices
from pimper_torch.records.value_checks import not_finite, out_of_range
from pimper_torch.runtime.errors import InputError, OutputError
from pimper_torch.runtime.torch_settings import isolated

if TYPE_CHECKING:
    from trimesh import Trimesh

trimesh = lazy_loader.load("trimesh")  # takes a second
# Scalars per vertex, written and read under the names of the record's fields.
_ERRORS = ("confidence", "expected_error")
SUFFIXES = (".ply", ".obj", ".stl", ".off", ".glb")
_NEEDED = "PLY, OBJ, STL, OFF or GLB"
# Largest shift of a vertex by rounding, as a fraction of the mesh's size: a thousandth of a short
# edge of a fine mesh. A choice.
_MAX_ROUNDING = 1e-6
_KINDS = {"uint8": "uchar", "float32": "float", "float64": "double"}  # PLY's names


@isolated
def write_mesh(mesh: Mesh, path: Path | str) -> None:
    """Write a mesh as it is, in its unit and axes; ``mesh.save(path)`` is the same.

    Args:
        path: The suffix selects the format: ``.ply`` with all values of the vertices, ``.glb`` and
            ``.obj`` with normals and colours, ``.stl`` with faces alone. Folders are created.

    Raises:
        InputError: The suffix is a different one, or the mesh is invalid.
        OutputError: The file cannot be written.
    """
    path = Path(path)
    usual = {".ply": write_ply, ".glb": write_glb, ".obj": write_obj}
    writers: dict[str, Callable[[Mesh, Path], None]] = {**usual, ".stl": write_stl}
    if (write := writers.get(path.suffix.lower())) is None:
        raise InputError(
            f"{path}: cannot be written as a mesh, its suffix is {path.suffix!r}; needed: one of "
            f"{', '.join(writers)}."
        )
    mesh.check(str(path))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write(mesh, path)
    except OSError as error:
        raise OutputError(f"{path}: writing failed ({error}). Write elsewhere.") from error


def trimesh_of(mesh: Mesh) -> "Trimesh":
    """Return a mesh as one of trimesh; ``mesh.to_trimesh()`` is the same.

    Vertices keep their order. Albedo is in its vertex colours as sRGB, and confidence and expected
    error are in its ``vertex_attributes``.
    """
    mesh = mesh.detach().to("cpu")
    errors = {name: getattr(mesh, name) for name in _ERRORS}
    return trimesh.Trimesh(
        mesh.vertices_world.numpy(),
        mesh.faces.numpy(),
        vertex_normals=carried_normals(mesh).numpy(),
        vertex_colors=None if mesh.albedo is None else to_bytes(base_color(mesh).expand(-1, 3)),
        vertex_attributes={name: x.numpy() for name, x in errors.items() if x is not None},
        process=False,
    )


def write_ply(
    mesh: Mesh, path: Path | str, offset_world: Offset = NO_OFFSET, measured: FaceMask | None = None
) -> None:
    """Write a binary PLY with vertex normals, albedo as 8-bit sRGB colour, and errors.

    Errors are the properties ``confidence`` and ``expected_error``, the latter in scene units.
    Positions are ``double`` if ``float`` would move a vertex by more than a millionth of the mesh's
    size, as it does far from the origin.

    Args:
        offset_world: Added to the vertices; see ``SparseScene.offset_world``.
        measured: Face property of the same name; 0 for faces that close a hole.
    """
    columns = {"x y z": _positions(mesh, offset_world), "nx ny nz": carried_normals(mesh).float()}
    if mesh.albedo is not None:
        columns["red green blue"] = to_bytes(base_color(mesh).expand(-1, 3))
    for name in _ERRORS:
        errors = getattr(mesh, name)
        if errors is not None:
            columns[name] = errors.float()[:, None]
    names = " ".join(columns).split()
    arrays = [column.detach().cpu().numpy() for x in columns.values() for column in x.unbind(dim=1)]
    vertices = np.rec.fromarrays(arrays, formats=None, names=names, byteorder="<")
    face = [("count", "u1"), ("corners", "<i4", 3)]
    faces = np.empty(len(mesh.faces), face if measured is None else [*face, ("measured", "u1")])
    faces["count"], faces["corners"] = 3, mesh.faces.cpu().numpy()
    if measured is not None:
        faces["measured"] = measured.cpu().numpy()
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(vertices)}",
        *(f"property {_KINDS[vertices[name].dtype.name]} {name}" for name in names),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        *([] if measured is None else ["property uchar measured"]),
        "end_header",
    ]
    with Path(path).open("wb") as file:
        file.write("".join(f"{line}\n" for line in header).encode("ascii"))
        vertices.tofile(file)
        faces.tofile(file)


def _positions(mesh: Mesh, offset_world: Offset) -> Vertices:
    """Return the positions to write: float32 if that is exact enough, else float64."""
    vertices = mesh.vertices_world.detach().double()
    shifted = vertices + vertices.new_tensor(offset_world)
    single = shifted.float()
    if len(vertices) == 0:
        return single
    size = (vertices.amax(dim=0) - vertices.amin(dim=0)).norm()
    rounded = (shifted - single).abs().max() > _MAX_ROUNDING * size
    return shifted if bool(rounded) else single


@isolated
def read_mesh(path: Path | str) -> Mesh:
    """Read a triangle mesh or a point cloud: PLY, OBJ, STL, OFF or GLB.

    Polygons are triangulated, and the parts of a scene are merged; vertices keep their order and
    number. Vertex normals are read if present; colours become albedo (converted from sRGB, except
    in glTF, whose colours are linear); ``confidence`` and ``expected_error`` are read from PLY.
    Any of these with values that are not finite is dropped. A point cloud becomes a mesh without
    faces.

    Args:
        path: The file. Its textures and materials are not read.

    Returns:
        Float64 geometry on the CPU.

    Raises:
        InputError: The file does not exist, is not a mesh, is shorter than its header states, or
            has no vertices, vertices that are not finite, or faces with invalid indices.
    """
    path = Path(path)
    if not path.is_file():
        found = "a folder" if path.is_dir() else "nothing"
        raise InputError(f"{path}: found {found}; needed: a mesh file such as .ply or .obj.")
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        found = f"its suffix is {suffix}" if suffix else "its name has no suffix"
        raise InputError(f"{path}: cannot be read as a mesh, {found}; needed: {_NEEDED}.")
    try:
        parts = _parts(path, suffix)
    except InputError:
        raise
    except Exception as error:  # parsers of trimesh raise errors of many types
        raise InputError(
            f"{path}: cannot be read as a mesh, it seems damaged; needed: {_NEEDED}."
        ) from error
    parts = [part for part in parts if len(part.vertices_world)]
    if not parts:
        raise InputError(f"{path}: has no vertices; needed: a mesh or a point cloud.")
    mesh = _joined(parts)
    if not bool(mesh.vertices_world.isfinite().all()):
        raise InputError(f"{path}: some vertices are not finite; needed: finite coordinates.")
    if found := out_of_range(mesh.faces, len(mesh.vertices_world)):
        raise InputError(
            f"{path}: the corners of its faces {found}; needed: indices of its "
            f"{len(mesh.vertices_world)} vertices. Export it again."
        )
    return mesh


def write_glb(
    mesh: Mesh, path: Path | str, offset_world: Offset = NO_OFFSET, measured: FaceMask | None = None
) -> None:
    """Write a binary glTF with the frame, normals and colours of the PLY.

    glTF has no doubles in its buffers: vertices stay near the origin, and the ``translation`` of
    their node, which is text, is the exact offset. Programs that apply it in single precision,
    such as Blender, round the position of the model and keep its shape.

    glTF's colours are linear, so they are the albedo; the material is matte and double-sided.
    glTF's y is up: viewers show the model in the world frame of structure from motion, whose up
    direction is arbitrary.

    Args:
        offset_world: Translation of the node; see ``SparseScene.offset_world``.
        measured: The attribute ``_MEASURED`` is 0 at vertices without such a face.
    """
    attributes = {"POSITION": mesh.vertices_world, "NORMAL": carried_normals(mesh)}
    if mesh.albedo is not None:
        attributes["COLOR_0"] = base_color(mesh).expand(-1, 3)
    if measured is not None:
        attributes["_MEASURED"] = corners_of(mesh.faces, measured, len(mesh.vertices_world))
    data = gltf_of(
        {name: values.detach().cpu().numpy() for name, values in attributes.items()},
        mesh.faces.cpu().numpy(),
        MATTE,
        offset_world=offset_world,
    )
    Path(path).write_bytes(data)


def write_stl(mesh: Mesh, path: Path | str, placement: Placement | None = None) -> None:
    """Write a binary STL, with a placement for printing; without one, the vertices as they are.

    For printing, z is up, and the mesh stands on the middle of the bed, in millimetres. The front
    is towards -y. Without a known unit, the longest side of the asset is 100 mm.
    """
    mesh, unit = mesh.detach().to("cpu"), b""
    points = mesh.vertices_world
    if placement is not None:
        x, up, front = placement.placed(points, points)[0].unbind(dim=1)
        points = (1000 if placement.metric else 100) * torch.stack([x, -front, up], dim=1)
        low, high = points.aminmax(dim=0)
        points, unit = points - torch.cat([(low + high)[:2] / 2, low[2:]]), b", millimetres"
    fields = [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")]
    rows = np.zeros(len(mesh.faces), fields)
    rows["corners"] = points[mesh.faces].numpy()
    rows["normal"] = unit_face_normals(points, mesh.faces).numpy()
    header = (b"pimper_torch" + unit).ljust(80)
    Path(path).write_bytes(header + struct.pack("<I", len(rows)) + rows.tobytes())


def write_obj(
    mesh: Mesh, path: Path | str, offset_world: Offset = NO_OFFSET, measured: FaceMask | None = None
) -> None:
    """Write an OBJ with vertex normals, and albedo as sRGB colour after each position.

    Args:
        offset_world: Added to the vertices; see ``SparseScene.offset_world``.
        measured: All other faces are in a separate group ``caps``.
    """
    rows = mesh.vertices_world.detach().cpu().double() + torch.tensor(offset_world).double()
    if mesh.albedo is not None:
        colors = srgb_from_linear(base_color(mesh).expand(-1, 3))
        rows = torch.cat([rows, colors.cpu().double()], dim=1)
    kept = torch.ones(len(mesh.faces), dtype=torch.bool) if measured is None else measured.cpu()
    with Path(path).open("w", encoding="ascii") as file:
        digits = 9 if offset_world == NO_OFFSET else 15
        numbers = " ".join([f"%.{digits}g"] * 3 + ["%.6g"] * (rows.shape[1] - 3))
        np.savetxt(file, rows.numpy(), fmt=f"v {numbers}")
        np.savetxt(file, carried_normals(mesh).detach().cpu().numpy(), fmt="vn %.6g %.6g %.6g")
        for group, chosen in (("measured", kept), ("caps", ~kept)):
            if bool(chosen.any()):
                file.write(f"g {group}\n")
                corners = mesh.faces.cpu()[chosen].repeat_interleave(2, dim=1) + 1
                np.savetxt(file, corners.numpy(), fmt="f %d//%d %d//%d %d//%d")


def _parts(path: Path, suffix: str) -> list[Mesh]:
    """Read the parts of a scene with trimesh, transformed to the scene."""
    # Without a resolver, no other file is opened.
    scene = trimesh.load_scene(
        BytesIO(_readable(path, suffix)),
        file_type=suffix.lstrip("."),
        process=False,
        maintain_order=True,
    )
    placed = [scene.graph[node] for node in scene.graph.nodes_geometry]
    count = sum(len(scene.geometry[name].vertices) for _, name in placed)
    if count > 100_000_000:  # a scene may contain many instances of a mesh
        raise InputError(f"{path}: its scene has {count} vertices; needed: at most 100,000,000.")
    return [_mesh(scene.geometry[name], pose, linear=suffix == ".glb") for pose, name in placed]


def _mesh(part: Any, pose: np.ndarray, *, linear: bool) -> Mesh:  # noqa: ANN401 - untyped
    """Convert a part of a trimesh scene, transformed by its pose in the scene."""
    scene_from_part = torch.tensor(np.asarray(pose), dtype=torch.float64)
    faces = torch.tensor(np.asarray(getattr(part, "faces", ())).reshape(-1, 3)).long()
    # trimesh computes normals that a file lacks; those of the file are in its cache.
    normals = _rows(part._cache.cache.get("vertex_normals"))
    colors = getattr(part, "colors", None)
    if len(faces):
        visual = part.visual
        colors = visual.vertex_colors if visual.kind == "vertex" else None
        colors = part.vertex_attributes.get(_RAW_COLORS, colors)
    encoded = _rows(colors)
    if encoded is not None:
        kind = np.asarray(colors).dtype
        encoded = encoded[:, :3] / (np.iinfo(kind).max if kind.kind in "ui" else 1)
    vertices = np.asarray(part.vertices, dtype=np.float64).reshape(-1, 3)
    raw = part.metadata.get("_ply_raw", {}).get("vertex", {}).get("data", {})
    columns = getattr(getattr(raw, "dtype", None), "names", None) or raw
    errors = {name: _rows(raw[name]) if name in columns else None for name in _ERRORS}
    if normals is None and {"nx", "ny", "nz"} <= set(columns):  # trimesh drops those of a cloud
        normals = _rows(np.stack([np.ravel(raw[axis]) for axis in ("nx", "ny", "nz")], axis=1))
    return Mesh(
        vertices_world=transform(scene_from_part, torch.tensor(vertices)),
        faces=faces,
        normals_world=None
        if normals is None
        else normalize(rotate(scene_from_part, normals), dim=-1),
        albedo=encoded if linear or encoded is None else linear_from_srgb(encoded),
        **{name: None if rows is None else rows.reshape(-1) for name, rows in errors.items()},
    )


def _rows(values: Any) -> Tensor | None:  # noqa: ANN401 - untyped
    if values is None or len(values) == 0:
        return None
    # A copy, as torch does not support the stride of a column of records.
    return torch.from_numpy(np.array(values, dtype=np.float64))


def _joined(parts: Sequence[Mesh]) -> Mesh:
    """Merge parts to one mesh, with attributes that are complete and finite in every part."""
    starts = accumulate((len(part.vertices_world) for part in parts), initial=0)
    faces = [part.faces + start for part, start in zip(parts, starts, strict=False)]
    attributes: dict[str, Tensor] = {}
    for name in ("normals_world", "albedo", *_ERRORS):
        values = [getattr(part, name) for part in parts]
        if all(value is not None and not not_finite(value) for value in values):
            attributes[name] = torch.cat(values)
    return Mesh(
        vertices_world=torch.cat([part.vertices_world for part in parts]),
        faces=torch.cat(faces),
        **attributes,
    )


# glTF's name of vertex colours, which trimesh rounds or truncates to 8 bits, and a name of which
# it keeps the values.
_COLORS, _RAW_COLORS = "COLOR_0", "_COLOR_0"


def _readable(path: Path, suffix: str) -> bytes:
    """Return a file's bytes, changed so that trimesh reads all attributes, after checks."""
    data = path.read_bytes()
    if suffix == ".glb":
        return _with_raw_colors(path, data)
    header, _, body = data.partition(b"end_header")
    if suffix == ".ply" and b"format ascii" in header:
        counts = re.findall(rb"^element \S+ (\d+)", header, re.MULTILINE)
        stated, rows = sum(map(int, counts)), len(body.strip().splitlines())
        if stated > rows:
            raise InputError(
                f"{path}: cannot be read as a mesh, its header states {stated} rows, but it has "
                f"{rows}. Export it again."
            )
    return data


def _with_raw_colors(path: Path, data: bytes) -> bytes:
    """Rename colours in a GLB file, except of points, whose custom attributes trimesh drops."""
    (size,) = struct.unpack_from("<I", data, 12)
    tree = json.loads(data[20 : 20 + size])
    if any("sparse" in item or "bufferView" not in item for item in tree.get("accessors", [])):
        raise InputError(
            f"{path}: cannot be read as a mesh, its values are sparse or compressed. Export it "
            "without compression."
        )
    for mesh in tree.get("meshes", []):
        for part in mesh["primitives"]:
            if _COLORS in part["attributes"] and part.get("mode") != 0:
                part["attributes"][_RAW_COLORS] = part["attributes"].pop(_COLORS)
    return glb(tree, data[28 + size :])
