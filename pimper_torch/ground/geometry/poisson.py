"""COLMAP's surfaces: screened Poisson reconstruction, and meshes of few faces.

Both run on one thread: on several, sums in another order give another surface in each run.
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

from pimper_torch.ground.geometry.colmap_library import loaded, quiet
from pimper_torch.ground.geometry.nearest import NearestSurface
from pimper_torch.ground.geometry.surfaces import barycentric
from pimper_torch.ground.geometry.topology import half_edges
from pimper_torch.ground.shapes import Faces, Points, Vertices
from pimper_torch.records import Mesh
from pimper_torch.runtime.config import require
from pimper_torch.runtime.errors import ReconstructionError

# COLMAP's octree is dense down to this depth, or to the least that any call of the process asked
# for: a call with less would change the surfaces of all calls after it.
_DENSE_DEPTH = 5


def poisson_surface(
    points: Points, normals: Points, *, depth: int, point_weight: float
) -> tuple[Vertices, Faces]:
    """Put a closed surface through oriented points by screened Poisson reconstruction.

    Args:
        depth: Of the octree: the longest side of the points' box is at most ``2 ** depth``
            cells; 5 at least.
        point_weight: Of the points against the smoothness.

    Returns:
        Vertices and faces, counter-clockwise from outside; without faces if there is no
        surface. It closes where there are no points, too: what is not borne out is the
        caller's to cut off.

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
        return _made(surface, "Poisson", pycolmap.poisson_meshing, cloud, surface, options)


def reduced(mesh: Mesh, num_faces: int) -> Mesh:
    """Merge vertices where that changes the planes of faces least, until few faces are left.

    Borders count ten times as much as the surface. Normals, albedo, confidence and expected error
    are those of the nearest place of the former surface, blended over its face. A constant to
    autograd.

    Args:
        num_faces: Of the result at most; a few more are left where nothing else can be merged.

    Raises:
        ConfigError: Fewer than 4 faces are asked for.
        ReconstructionError: COLMAP cannot simplify the mesh.

    Source: Garland & Heckbert, Surface simplification using quadric error metrics,
    SIGGRAPH 1997.
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
    # COLMAP works in single precision: a mesh far from the origin is brought there.
    places = mesh.vertices_world.detach().cpu().double()
    centre = places.median(dim=0).values
    with tempfile.TemporaryDirectory() as folder:
        before, after = Path(folder) / "before.ply", Path(folder) / "after.ply"
        moved = trimesh.Trimesh((places - centre).numpy(), mesh.faces.cpu().numpy(), process=False)
        moved.export(before, vertex_normal=False)
        vertices, faces = _made(
            after, "simplification", pycolmap.simplify_mesh, before, after, options
        )
    used, faces = torch.unique(_oriented(faces), return_inverse=True)
    points = vertices[used].double() + centre
    known = [one.name for one in fields(Mesh) if getattr(mesh, one.name) is not None][2:]
    return Mesh(
        vertices_world=points.to(mesh.vertices_world),
        faces=faces.to(mesh.faces),
        **(_nearest_values(mesh, known, points) if known else {}),
    )


def _nearest_values(mesh: Mesh, names: list[str], points: Points) -> dict[str, Tensor]:
    places = mesh.vertices_world.detach().cpu().double()
    nearest = NearestSurface(mesh).query(points)
    corners = mesh.faces.cpu()[nearest.face]
    weights = barycentric(nearest.points, places[corners])

    def blended(values: Tensor) -> Tensor:
        rows = values.detach().cpu().double()[corners].reshape(len(corners), 3, -1)
        return (weights[..., None] * rows).sum(dim=1).reshape(-1, *values.shape[1:])

    found = {name: blended(getattr(mesh, name)).to(getattr(mesh, name)) for name in names}
    if "normals_world" in found:
        found["normals_world"] = normalize(found["normals_world"], dim=-1)
    return found


def _oriented(faces: Faces) -> Int[Tensor, "kept 3"]:
    """Drop faces that run along an edge the way that an earlier face does."""
    ends = half_edges(faces)
    _, label = torch.unique(ends[:, 0] * (int(faces.max()) + 1) + ends[:, 1], return_inverse=True)
    number = torch.arange(len(faces)).repeat_interleave(3)
    first = torch.full_like(label, len(faces)).scatter_reduce(0, label, number, "amin")
    return faces[(first[label] == number).reshape(-1, 3).all(dim=1)]


def _made(
    path: Path, what: str, program: Callable[..., object], *arguments: object
) -> tuple[Vertices, Faces]:
    """Run a program of COLMAP's that writes a mesh, and read that; float32."""
    import trimesh

    try:
        with quiet():
            program(*arguments)
        mesh = trimesh.load_mesh(path, process=False)
    except (ValueError, RuntimeError, OSError) as error:
        raise ReconstructionError(
            f"surface: COLMAP's {what} made no mesh ({error}). Take more photographs of "
            "textured surface, or bring a mesh of your own."
        ) from error
    vertices = torch.from_numpy(np.array(mesh.vertices, dtype=np.float32).reshape(-1, 3))
    return vertices, torch.from_numpy(np.array(mesh.faces, dtype=np.int64).reshape(-1, 3))
