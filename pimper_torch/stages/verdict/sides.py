"""Sides of an object that no photograph shows."""

import torch
from torch.nn.functional import normalize

from pimper_torch.geometry.pinholes import up_world
from pimper_torch.records import Cameras, Mesh

# A side without cameras has none within 60 degrees; less than half of an open side is surface.
_COS_NEAR, _HALF = 0.5, 0.5


def unphotographed(mesh: Mesh, cameras: Cameras) -> list[str]:
    """Name the sides without cameras at which the mesh is open: back, top, underside.

    Directions are from the mean of the vertices, and the back is opposite of the cameras' mean. Of
    a closed mesh, faces that look along a direction and against it have equal areas in projection.
    """
    up, center = up_world(cameras), mesh.vertices_world.mean(dim=0)
    views = normalize(cameras.centers_world - center, dim=1)
    front = views.mean(dim=0)
    sides = {"back": normalize((front @ up) * up - front, dim=0), "top": up, "underside": -up}
    first, second, third = mesh.vertices_world[mesh.faces].unbind(dim=1)
    areas = torch.linalg.cross(second - first, third - first)

    def is_open(side: str) -> bool:
        along = areas @ sides[side]
        return bool(along.clamp_min(0).sum() < _HALF * (-along).clamp_min(0).sum())

    return [side for side in sides if (views @ sides[side]).max() < _COS_NEAR and is_open(side)]
