"""What is visible from a surface's vertices: a fraction of the sky, and the cameras."""

import torch
from jaxtyping import Bool
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.geometry.directions import even_directions
from pimper_torch.geometry.projection import project
from pimper_torch.geometry.surfaces import carried_normals
from pimper_torch.geometry.visibility import ray_caster
from pimper_torch.records import Cameras, Mesh
from pimper_torch.records.shapes import PerVertex, Vertices

# Rays of a vertex over the sphere, half of them above the surface: brightness is off by 0.02. A
# choice: 21,630 vertices take 1 s on a core.
_RAYS = 96
# Offset of rays from the surface, as a fraction of the diagonal; like shadow rays of predictions.
_LIFT = 0.002


def openness(mesh: Mesh) -> PerVertex:
    r"""Return the irradiance under a uniform white sky, as a fraction of the unoccluded irradiance.

    :math:`\int v(\omega) (n \cdot \omega) d\omega / \pi` over the hemisphere above the vertex, with
    visibility :math:`v`. Not differentiable.
    """
    mesh = mesh.detach().to("cpu", torch.float32)
    caster, (starts, normals) = ray_caster(mesh), _starts(mesh)
    visible, total = torch.zeros_like(starts[:, 0]), torch.zeros_like(starts[:, 0])
    for direction in even_directions(_RAYS).float():
        cosine = (normals @ direction).clamp_min(0)
        above = cosine > 0
        rays = direction.expand(int(above.sum()), 3)
        free = ~caster.blocked(starts[above], rays, torch.full_like(rays[:, 0], torch.inf))
        visible[above] += cosine[above] * free
        total += cosine
    return (visible / total).nan_to_num(1)  # a vertex without a normal


def photographed(mesh: Mesh, cameras: Cameras) -> Bool[Tensor, " vertex"]:
    """Return whether a camera shows each vertex: in its image, facing it and not occluded."""
    mesh = mesh.detach().to("cpu", torch.float32)
    cameras = cameras.detach().to("cpu", torch.float32)
    caster, (starts, normals) = ray_caster(mesh), _starts(mesh)
    shown = torch.zeros(len(starts), dtype=torch.bool)
    for view, center in enumerate(cameras.centers_world):
        pixels, depth = project(starts, cameras.cam_from_world[view], cameras.intrinsics[view])
        inside = ((pixels > 0) & (pixels < cameras.sizes_px[view])).all(dim=1) & (depth > 0)
        towards = center - starts
        open_to = inside & ((towards * normals).sum(dim=1) > 0) & ~shown
        rays = starts[open_to], towards[open_to]
        shown[open_to] = ~caster.blocked(*rays, torch.ones_like(depth[open_to]))
    return shown


def _starts(mesh: Mesh) -> tuple[Vertices, Vertices]:
    """Return the origins of the vertices' rays, slightly above the surface, and unit normals."""
    vertices, normals = mesh.vertices_world, normalize(carried_normals(mesh), dim=-1)
    diagonal = (vertices.amax(dim=0) - vertices.amin(dim=0)).norm()
    return vertices + _LIFT * diagonal * normals, normals
