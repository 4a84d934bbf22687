"""A cloud that came with cameras, without tracks: its points are looked for in the photographs."""

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import ConvexHull, QhullError
from torch import Tensor

from pimper_torch.ground.geometry.projection import project
from pimper_torch.ground.shapes import Points
from pimper_torch.method.sfm.model import SparseModel
from pimper_torch.method.sfm.refine_tracks import found_again
from pimper_torch.method.sfm.undistort import pinholes_for
from pimper_torch.records import Views

# Points that are looked for, evenly among those of the cloud: what structure from motion finds on
# an object. A choice.
_MOST = 5000
# Radius of the sphere of flipping over the distance of the farthest point. Of 5000 vertices of the
# demo 1,640 are found with 100, and 950 with 10, which takes hollows for hidden. With 1000, points
# on the far side of a ball count as seen.
_RADIUS = 100.0


def cloud_tracks(views: Views, model: SparseModel) -> SparseModel:
    """Find points of a cloud in the photographs that show them.

    A point is expected in the views that no other point hides it from, and is there where its
    patch is found: points of another scene, or of another frame, are found nowhere.

    Args:
        model: Cameras, held fixed, and points without observations.

    Returns:
        With the points that three views or more show.
    """
    count = len(model.points_world)
    kept = torch.linspace(0, count - 1, min(count, _MOST)).round().long()
    points = model.points_world[kept]
    pixels, depth = project(points, model.cam_from_world, pinholes_for(model.lenses))
    sizes = torch.tensor([[[lens.width, lens.height]] for lens in model.lenses])
    inside = ((pixels > 0) & (pixels < sizes)).all(dim=-1) & (depth > 0)
    rotations, shifts = model.cam_from_world[:, :3, :3], model.cam_from_world[:, :3, 3]
    centers = -(rotations.mT @ shifts[..., None])[..., 0]
    seen = torch.stack([in_sight(points, center) for center in centers])
    point, view = torch.nonzero((seen & inside).mT, as_tuple=True)
    expected = model.replace(
        points_world=points,
        observation_point=point,
        observation_view=view,
        observation_pixels=pixels[view, point],
    )
    return found_again(views, expected)


def in_sight(points_world: Points, center_world: Float[Tensor, "3"]) -> Bool[Tensor, " point"]:
    """Return which points of a surface no others hide from a viewpoint.

    Source: Katz, Tal & Basri, Direct visibility of point sets, SIGGRAPH 2007: points flipped at a
    sphere around the viewpoint are seen where they lie on the convex hull.
    """
    rays = (points_world - center_world).numpy()
    lengths = np.linalg.norm(rays, axis=1, keepdims=True).clip(1e-12)
    flipped = rays * (2 * _RADIUS * lengths.max() / lengths - 1)
    seen = torch.zeros(len(rays) + 1, dtype=torch.bool)
    try:
        # Joggled: points that lie on one plane have a hull, too.
        hull = ConvexHull(np.concatenate([flipped, np.zeros((1, 3))]), qhull_options="QJ")
        seen[torch.from_numpy(hull.vertices).long()] = True
    except QhullError:  # of a few points, or of one place, none hides another
        seen[:] = True
    return seen[:-1]
