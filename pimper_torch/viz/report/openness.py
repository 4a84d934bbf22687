"""Fraction of the sky visible from a surface's vertices: ambient occlusion."""

import torch
from torch.nn.functional import normalize

from pimper_torch.geometry.directions import even_directions
from pimper_torch.geometry.surfaces import carried_normals
from pimper_torch.geometry.visibility import ray_caster
from pimper_torch.records import Mesh
from pimper_torch.records.shapes import PerVertex

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
    vertices, normals = mesh.vertices_world, normalize(carried_normals(mesh), dim=-1)
    diagonal = (vertices.amax(dim=0) - vertices.amin(dim=0)).norm()
    caster, starts = ray_caster(mesh), vertices + _LIFT * diagonal * normals
    visible, total = torch.zeros_like(vertices[:, 0]), torch.zeros_like(vertices[:, 0])
    for direction in even_directions(_RAYS).float():
        cosine = (normals @ direction).clamp_min(0)
        above = cosine > 0
        rays = direction.expand(int(above.sum()), 3)
        free = ~caster.blocked(starts[above], rays, torch.full_like(rays[:, 0], torch.inf))
        visible[above] += cosine[above] * free
        total += cosine
    return (visible / total).nan_to_num(1)  # a vertex without a normal
