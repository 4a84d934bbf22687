"""The part of the sky that a surface's vertices see: ambient occlusion."""

import torch
from torch.nn.functional import normalize

from pimper_torch.ground.geometry.directions import even_directions
from pimper_torch.ground.geometry.visibility import ray_caster
from pimper_torch.ground.shapes import PerVertex
from pimper_torch.records import Mesh
from pimper_torch.result.viz.maps import carried_normals

# Rays of a vertex over the whole sphere, half of them above the surface: levels of a picture are
# off by 0.02. A choice: 21,630 vertices take 1 s on a core.
_RAYS = 96
# Rays start this fraction of the diagonal above the surface, as shadow rays of predictions do.
_LIFT = 0.002


def openness(mesh: Mesh) -> PerVertex:
    r"""Return the irradiance under a white sky on all sides, as a fraction of the unoccluded one.

    :math:`\int v(\omega) (n \cdot \omega) d\omega / \pi` over the hemisphere above the vertex, with
    visibility :math:`v`; a constant to autograd.
    """
    mesh = mesh.detach().to("cpu", torch.float32)
    places, normals = mesh.vertices_world, normalize(carried_normals(mesh), dim=-1)
    diagonal = (places.amax(dim=0) - places.amin(dim=0)).norm()
    caster, starts = ray_caster(mesh), places + _LIFT * diagonal * normals
    open_to, whole = torch.zeros_like(places[:, 0]), torch.zeros_like(places[:, 0])
    for direction in even_directions(_RAYS).float():
        cosine = (normals @ direction).clamp_min(0)
        above = cosine > 0
        rays = direction.expand(int(above.sum()), 3)
        free = ~caster.blocked(starts[above], rays, torch.full_like(rays[:, 0], torch.inf))
        open_to[above] += cosine[above] * free
        whole += cosine
    return (open_to / whole).nan_to_num(1)  # a vertex without a normal
