"""COLMAP's screened Poisson reconstruction and mesh simplification.

Both run on one thread: with several, the order of sums and so the surface differ between runs.
"""

import tempfile
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.geometry.colmap_library import loaded, quiet
from pimper_torch.geometry.nearest import NearestSurface
from pimper_torch.geometry.surfaces import barycentric
from pimper_torch.geometry.topology import half_edges
from pimper_torch.records import Mesh
from pimper_torch.records.shapes import Faces, Points, Vertices
from pimper_torch.runtime.config import require
from pimper_torch.runtime.errors import ReconstructionError

# COLMAP's octree is dense down to this depth, or to the least depth of any call in the process:
# a call with less would change the surfaces of all later calls.
_DENSE_DEPTH = 5


def poisson_surface(
    points: Points, normals: Points, *, depth: int, point_weight: float
) -> tuple[Vertices, Faces]:
    """Fit a closed surface to oriented points by screened Poisson reconstruction.

    Args:
        depth: Of the octree, at least 5: the points' box has up to ``2 ** depth`` cells a side.
        point_weight: Weight of the points relative to the smoothness.

    Returns:
        Vertices and faces, counter-clockwise from outside; without a surface, no faces. It is
        closed even where there are no points: the caller removes parts without support.

    Raises:
        ReconstructionError: COLMAP cannot make a surface of the points.

    Source: Kazhdan & Hoppe, Screened Poisson surface reconstruction, TOG 32(3), 2013.
    """
    pycolmap = loaded()

    options = pycolmap.PoissonMeshingOptions()
    options.depth, options.point_weight = max(_DENSE_DEPTH, depth), point_weight
    options.trim, options.color, options.num_threads = 0.0, False, 1
    properties = "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
    start = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n"
    rows = torch.cat([points, normals], dim=1).detach().cpu().float().numpy().astype("<f4")
    with tempfile.TemporaryDirectory() as folder:
        cloud, surface = Path(folder) / "cloud.ply", Path(folder) / "surface.ply"
        cloud.write_bytes(f"{start}{properties}end_header\n".encode("ascii") + rows.tobytes())
        program = pycolmap.poisson_meshing
        return _mesh_from(surface, "Poisson reconstruction", program, cloud, surface, options)


def reduced(mesh: Mesh, num_faces: int) -> Mesh:
    """Simplify a mesh to about ``num_faces`` faces by merging vertices, least error first.

    Boundaries count ten times as much as the surface. Normals, albedo, confidence and expected
    error are interpolated at the nearest point of the original surface. Not differentiable.

    Args:
        num_faces: Maximum; a few more remain if no other vertices can be merged.

    Raises:
        ConfigError: ``num_faces`` is less than 4.
        ReconstructionError: COLMAP cannot simplify the mesh.

    Source: Garland & Heckbert, Surface simplification using quadric error metrics, SIGGRAPH 1997.
    """
    require(num_faces >= 4, "faces", num_faces, "4 at least, those of a tetrahedron")
    if len(mesh.faces) <= num_faces:
        return mesh
    import trimesh

    pycolmap = loaded()
    options = pycolmap.MeshSimplificationOptions()
    options.target_face_ratio = num_faces / len(mesh.faces)
    options.boundary_weight, options.num_threads = 10.0, 1
    options.interpolate_colors = False
    # COLMAP works in single precision, which is finest near the origin.
    vertices_world = mesh.vertices_world.detach().cpu().double()
    centre = vertices_world.median(dim=0).values
    with tempfile.TemporaryDirectory() as folder:
        before, after = Path(folder) / "before.ply", Path(folder) / "after.ply"
        shifted = (vertices_world - centre).numpy(), mesh.faces.cpu().numpy()
        trimesh.Trimesh(*shifted, process=False).export(before, vertex_normal=False)
        program = pycolmap.simplify_mesh
        vertices, faces = _mesh_from(after, "simplification", program, before, after, options)
    faces = _oriented(faces)
    # A small piece collapses to two faces back to back, which have no normal.
    corners = faces.sort(dim=1).values
    _, same, times = torch.unique(corners, dim=0, return_inverse=True, return_counts=True)
    used, faces = torch.unique(faces[times[same] == 1], return_inverse=True)
    points = vertices[used].double() + centre
    names = [field.name for field in fields(Mesh) if getattr(mesh, field.name) is not None][2:]
    return Mesh(
        vertices_world=points.to(mesh.vertices_world),
        faces=faces.to(mesh.faces),
        **(_nearest_values(mesh, names, points) if names else {}),
    )


def _nearest_values(mesh: Mesh, names: list[str], points: Points) -> dict[str, Tensor]:
    nearest = NearestSurface(mesh).query(points)
    corners = mesh.faces.cpu()[nearest.face]
    weights = barycentric(nearest.points, mesh.vertices_world.detach().cpu().double()[corners])

    def interpolate(values: Tensor) -> Tensor:
        rows = values.detach().cpu().double()[corners].reshape(len(corners), 3, -1)
        return (weights[..., None] * rows).sum(dim=1).reshape(-1, *values.shape[1:])

    result = {name: interpolate(getattr(mesh, name)).to(getattr(mesh, name)) for name in names}
    if "normals_world" in result:
        result["normals_world"] = normalize(result["normals_world"], dim=-1)
    return result


def _oriented(faces: Faces) -> Int[Tensor, "kept 3"]:
    """Drop faces that traverse an edge in the same direction as an earlier face."""
    ends = half_edges(faces)
    _, label = torch.unique(ends[:, 0] * (int(faces.max()) + 1) + ends[:, 1], return_inverse=True)
    number = torch.arange(len(faces)).repeat_interleave(3)
    first = torch.full_like(label, len(faces)).scatter_reduce(0, label, number, "amin")
    return faces[(first[label] == number).reshape(-1, 3).all(dim=1)]


def _mesh_from(
    path: Path, name: str, program: Callable[..., object], *arguments: object
) -> tuple[Vertices, Faces]:
    """Run a function of COLMAP's that writes a mesh, and read the mesh; float32 vertices."""
    import trimesh

    try:
        with quiet():
            program(*arguments)
        mesh = trimesh.load_mesh(path, process=False)
    except (ValueError, RuntimeError, OSError) as error:
        raise ReconstructionError(
            f"surface: COLMAP's {name} produced no mesh ({error}). Take more photographs of "
            "textured surface, or provide a mesh."
        ) from error
    vertices = torch.from_numpy(np.array(mesh.vertices, dtype=np.float32).reshape(-1, 3))
    return vertices, torch.from_numpy(np.array(mesh.faces, dtype=np.int64).reshape(-1, 3))
