"""Clouds and meshes as the PLY files that COLMAP's programs exchange."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

_PLACE = [(name, "<f4") for name in ("x", "y", "z")]
_NORMAL = [(name, "<f4") for name in ("nx", "ny", "nz")]


def write_cloud(
    points: Float[Tensor, "point 3"], normals: Float[Tensor, "point 3"], path: Path
) -> None:
    """Write points with normals as binary PLY."""
    rows = np.empty(len(points), dtype=np.dtype(_PLACE + _NORMAL))
    values = torch.cat([points, normals], dim=1).detach().cpu().float().numpy()
    for column, (name, _) in enumerate(_PLACE + _NORMAL):
        rows[name] = values[:, column]
    properties = "".join(f"property float {name}\n" for name, _ in _PLACE + _NORMAL)
    _write(path, f"element vertex {len(rows)}\n{properties}", rows.tobytes())


def write_faces(
    vertices: Float[Tensor, "vertex 3"], faces: Int[Tensor, "face 3"], path: Path
) -> None:
    """Write a triangle mesh as binary PLY."""
    places = np.ascontiguousarray(vertices.detach().cpu().float().numpy().astype("<f4"))
    rows = np.empty(len(faces), dtype=np.dtype([("count", "u1"), ("corners", "<i4", 3)]))
    rows["count"], rows["corners"] = 3, faces.cpu().numpy()
    header = (
        f"element vertex {len(places)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element face {len(rows)}\nproperty list uchar int vertex_indices\n"
    )
    _write(path, header, places.tobytes() + rows.tobytes())


def read_faces(path: Path) -> tuple[Float[Tensor, "vertex 3"], Int[Tensor, "face 3"]]:
    """Read a triangle mesh that COLMAP wrote; float32, vertices as they are in the file."""
    import trimesh

    mesh = trimesh.load_mesh(path, process=False)
    vertices = torch.from_numpy(np.array(mesh.vertices, dtype=np.float32).reshape(-1, 3))
    return vertices, torch.from_numpy(np.array(mesh.faces, dtype=np.int64).reshape(-1, 3))


def _write(path: Path, header: str, body: bytes) -> None:
    start = f"ply\nformat binary_little_endian 1.0\n{header}end_header\n"
    path.write_bytes(start.encode("ascii") + body)
