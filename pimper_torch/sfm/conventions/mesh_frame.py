"""Whether a brought mesh is where the photographs show the object."""

import math

from pimper_torch.errors import InputError, caution
from pimper_torch.geometry.nearest import NearestSurface
from pimper_torch.geometry.visibility import RayCaster
from pimper_torch.records import Mesh, SparseScene

_NEAR = (
    0.03  # of its diagonal, within which a point is on the mesh: rough meshes are off by as much
)


def compare_with_scene(mesh: Mesh, scene: SparseScene) -> dict[str, int | float]:
    """Compare a mesh with the points of a scene; warn of one that is far off.

    A point that a camera saw lies neither behind the mesh nor before it: rays to observed points
    meet the mesh at the point, or nowhere, as those to the background do.

    Returns:
        Figures, as far as they are known: median distance of points whose rays meet the mesh in per
        cent of its diagonal, the fraction of these on it, number of such rays.

    Raises:
        InputError: Next to nothing fits.
    """
    used = mesh.vertices_world[mesh.faces.flatten()].double()
    diagonal = float((used.amax(dim=0) - used.amin(dim=0)).norm())
    step = -(-len(scene.observation_point) // 4000) or 1
    point, view = scene.observation_point[::step], scene.observation_view[::step]
    origins = scene.cameras.centers_world.detach().double()[view].cpu()
    points = scene.points_world[point].detach().double().cpu()
    rays = points - origins
    cast = RayCaster(mesh.vertices_world, mesh.faces).cast(origins, rays)
    met, length = cast.face >= 0, rays.norm(dim=1)
    # Nothing is near in a mesh that the cameras are inside of.
    near = (cast.distance.double() - 1).abs() * length <= _NEAR * length.clamp_max(diagonal)
    hits, count = int(met.sum()), len(rays)
    on_mesh, distance = math.nan, math.nan
    told = f"rays to {hits} of {count} observed points meet it"
    if hits:
        distance = float(NearestSurface(mesh).query(points[met]).distance.median()) / diagonal
    if hits >= min(30, max(1, count // 4)):  # fewer tell nothing
        on_mesh = int((near & met).sum()) / hits
        told = (
            f"{on_mesh:.0%} of {hits} observed points whose rays meet it are within {_NEAR:.0%} of "
            f"its diagonal of it, their median distance is {100 * distance:.2g}% of the diagonal "
            f"({distance * diagonal:.3g})"
        )
    frame = "in the frame of the cameras, with their axes and their unit"
    # The box round an object is off by less than a tenth of its diagonal.
    if on_mesh < 0.1 and not distance < 0.1:
        raise InputError(
            f"The given mesh is not where the photographs show the object: {told}. It has to be "
            f"{frame}: give the model that it belongs to by `--sparse`, or align it first."
        )
    unknown = math.isnan(on_mesh) and count >= 30
    if unknown or distance > 0.02 or on_mesh < 0.8:
        caution(
            f"The given mesh is off what the photographs show: {told}. Look whether it is {frame}, "
            "and of this object."
        )
    figures = {"distance_percent": 100 * distance, "on_mesh": on_mesh, "observations": hits}
    return {name: value for name, value in figures.items() if not math.isnan(value)}
