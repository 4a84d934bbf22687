"""Tracks for the points of a given cloud, searched for in the photographs."""

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import ConvexHull, QhullError
from torch import Tensor

from pimper_torch.geometry.projection import project
from pimper_torch.geometry.rigid import invert_rigid
from pimper_torch.geometry.undistortion import pinholes_for
from pimper_torch.records import Views
from pimper_torch.records.shapes import Points
from pimper_torch.records.sparse_model import SparseModel
from pimper_torch.stages.sfm.refine_tracks import align_tracks

# Number of searched points, evenly sampled from the cloud: structure from motion finds as many on
# an object. A choice.
_MOST = 5000
# Radius of the flipping sphere over the distance of the farthest point. 1,640 of 5000 vertices of
# the demo are found with 100, and 950 with 10, for which hollows count as hidden. With 1000, points
# on the far side of a ball count as visible.
_RADIUS = 100.0


def cloud_tracks(views: Views, model: SparseModel) -> SparseModel:
    """Return the model with tracks of its cloud.

    A point is expected in the views from which no other point hides it, and is kept where its patch
    is found: points of a different scene or frame are not found anywhere.

    Args:
        model: Cameras, held fixed, and points without observations.

    Returns:
        The points that are visible in three views or more.
    """
    count = len(model.points_world)
    kept = torch.linspace(0, count - 1, min(count, _MOST)).round().long()
    points = model.points_world[kept]
    pixels, depth = project(points, model.cam_from_world, pinholes_for(model.lenses))
    sizes = torch.tensor([[[lens.width, lens.height]] for lens in model.lenses])
    inside = ((pixels > 0) & (pixels < sizes)).all(dim=-1) & (depth > 0)
    centers = invert_rigid(model.cam_from_world)[:, :3, 3]
    visible = torch.stack([visible_from(points, center) for center in centers])
    point, view = torch.nonzero((visible & inside).mT, as_tuple=True)
    expected = model.replace(
        points_world=points,
        observation_point=point,
        observation_view=view,
        observation_pixels=pixels[view, point],
    )
    return align_tracks(views, expected)


def visible_from(points_world: Points, center_world: Float[Tensor, "3"]) -> Bool[Tensor, " point"]:
    """Return which points of a surface are visible from a viewpoint, not hidden by other points.

    Source: Katz, Tal & Basri, Direct visibility of point sets, SIGGRAPH 2007: points flipped at a
    sphere around the viewpoint are visible if they are on the convex hull.
    """
    rays = (points_world - center_world).numpy()
    lengths = np.linalg.norm(rays, axis=1, keepdims=True).clip(1e-12)
    flipped = rays * (2 * _RADIUS * lengths.max() / lengths - 1)
    visible = torch.zeros(len(rays) + 1, dtype=torch.bool)
    try:
        # Joggled, so that points on one plane have a hull.
        hull = ConvexHull(np.concatenate([flipped, np.zeros((1, 3))]), qhull_options="QJ")
        visible[torch.from_numpy(hull.vertices).long()] = True
    except QhullError:  # few points, or points at one position, do not hide each other
        visible[:] = True
    return visible[:-1]
