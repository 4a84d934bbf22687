"""COLMAP's surfaces: screened Poisson reconstruction, and simplification.

Both run on one thread: on several, sums in another order give another surface in each run.
"""

import tempfile
from collections.abc import Callable
from pathlib import Path

from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.errors import ReconstructionError
from pimper_torch.sfm.binding import loaded, quiet
from pimper_torch.sfm.exchange import read_faces, write_cloud, write_faces

# COLMAP's octree is dense down to this depth, or to the least that any call of the process asked
# for: a call with less would change the surfaces of all calls after it.
_DENSE_DEPTH = 5

# Weight of a mesh's border against its area when vertices are merged. A choice.
_BORDER_WEIGHT = 10.0


def poisson_surface(
    points: Float[Tensor, "point 3"],
    normals: Float[Tensor, "point 3"],
    *,
    depth: int,
    point_weight: float,
) -> tuple[Float[Tensor, "vertex 3"], Int[Tensor, "face 3"]]:
    """Put a closed surface through oriented points by screened Poisson reconstruction.

    Args:
        points: On the surface, any unit.
        normals: Outward.
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
    with tempfile.TemporaryDirectory() as folder:
        cloud, surface = Path(folder) / "cloud.ply", Path(folder) / "surface.ply"
        write_cloud(points, normals, cloud)
        return _made(surface, "Poisson", pycolmap.poisson_meshing, cloud, surface, options)


def simplified(
    vertices: Float[Tensor, "vertex 3"],
    faces: Int[Tensor, "face 3"],
    num_faces: int,
) -> tuple[Float[Tensor, "left 3"], Int[Tensor, "few 3"]]:
    """Merge vertices of a mesh where that changes its planes least, until few faces are left.

    Borders count ten times as much as the surface. A mesh with no more faces comes back as it is.

    Args:
        vertices: Any unit.
        faces: Of the mesh.
        num_faces: About so many are left.

    Raises:
        ReconstructionError: COLMAP cannot simplify the mesh.

    Source: Garland & Heckbert, Surface simplification using quadric error metrics,
    SIGGRAPH 1997.
    """
    if len(faces) <= num_faces:
        return vertices, faces
    pycolmap = loaded()
    options = pycolmap.MeshSimplificationOptions()
    options.target_face_ratio = num_faces / max(1, len(faces))
    options.boundary_weight, options.num_threads = _BORDER_WEIGHT, 1
    options.interpolate_colors = False
    with tempfile.TemporaryDirectory() as folder:
        before, after = Path(folder) / "before.ply", Path(folder) / "after.ply"
        # COLMAP works in single precision: a mesh far from the origin is brought there.
        centre = vertices.median(dim=0).values
        write_faces(vertices - centre, faces, before)
        fewer, left = _made(after, "simplification", pycolmap.simplify_mesh, before, after, options)
        return fewer.to(vertices) + centre, left.to(faces)


def _made(
    path: Path,
    what: str,
    program: Callable[..., object],
    *arguments: object,
) -> tuple[Float[Tensor, "vertex 3"], Int[Tensor, "face 3"]]:
    """Run a program of COLMAP's that writes a mesh, and read that."""
    try:
        with quiet():
            program(*arguments)
        return read_faces(path)
    except (ValueError, RuntimeError, OSError) as error:
        raise ReconstructionError(
            f"surface: COLMAP's {what} made no mesh ({error}). Take more photographs of "
            "textured surface, or bring a mesh of your own."
        ) from error
