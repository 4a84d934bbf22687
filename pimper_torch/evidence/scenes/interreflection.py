"""Light that reaches a surface by way of others.

The fraction of its light that each vertex gets from each face depends on geometry only. It is
found once by casting rays, and each bounce of each photograph is then one sparse product.
"""

import numpy as np
import torch
from jaxtyping import Float
from scipy.sparse import csr_array
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.evidence.scenes.lights import PointLight
from pimper_torch.evidence.scenes.stage import Stage
from pimper_torch.geometry.directions import cosine_fan

_BATCH = 1 << 14  # vertices at once


class Interreflection:
    """Diffuse transfer between the faces and vertices of a stage.

    Args:
        stage: The objects; they do not move.
        bounces: How many surfaces light may touch before the one that is seen.
        num_rays: From each vertex; the more, the less its light differs from its neighbours'
            by chance.
        seed: Turns the fan of rays of each vertex.

    Highlights are not passed on, and neither is the ambient light, which stands for all that
    the room sends. ``light`` is in irradiance as :mod:`pimper_torch.evidence.scenes.shading` counts
    it: of a white surface, the radiance.
    """

    def __init__(self, stage: Stage, bounces: int, *, num_rays: int = 64, seed: int = 0) -> None:
        self.bounces = bounces
        self._fraction = transfer(stage, num_rays, seed)
        self._albedo = stage.vertex_albedo()[stage.mesh.faces].mean(dim=1)
        self._faces = stage.mesh.faces

    def light(self, stage: Stage, point_light: PointLight) -> Float[Tensor, "vertex channel"]:
        """Return what every vertex receives from other surfaces under a point light."""
        sent = self._albedo * _direct(stage, point_light)[:, None]
        if point_light.colour is not None:
            sent = sent * point_light.colour
        total = torch.zeros(self._fraction.shape[0], self._albedo.shape[1])
        for _ in range(self.bounces):
            received = torch.from_numpy(self._fraction @ sent.numpy())
            total = total + received
            sent = self._albedo * received[self._faces].mean(dim=1)
        return total


def transfer(stage: Stage, num_rays: int, seed: int) -> csr_array:
    """Return the fraction of each vertex' light that comes from each face, ``vertex face``.

    Where all faces have radiance 1, a row's sum is the irradiance of its vertex.
    """
    vertices = stage.mesh.vertices_world.float()
    normals = stage.vertex_normals
    generator = torch.Generator().manual_seed(seed)
    rotations = 2 * torch.pi * torch.rand(len(vertices), generator=generator)
    rows, columns = [], []
    for own in torch.split(torch.arange(len(vertices)), _BATCH):
        fan = cosine_fan(normals[own], rotations[own], num_rays)
        start = (vertices[own] + stage.clearance * normals[own])[:, None].expand_as(fan)
        face = stage.cast(start.reshape(-1, 3), fan.reshape(-1, 3)).face
        (met,) = torch.nonzero(face >= 0, as_tuple=True)
        rows.append(own[met // num_rays])
        columns.append(face[met])
    ends = (torch.cat(rows).numpy(), torch.cat(columns).numpy())
    fractions = np.full(len(ends[0]), 1 / num_rays, dtype=np.float32)
    return csr_array((fractions, ends), shape=(len(vertices), len(stage.mesh.faces)))


def _direct(stage: Stage, point_light: PointLight) -> Float[Tensor, " face"]:
    """Return the irradiance of every face's centre by the point light alone."""
    faces = stage.mesh.faces
    points = stage.mesh.vertices_world.float()[faces].mean(dim=1)
    normals = normalize(stage.vertex_normals[faces].mean(dim=1), dim=-1)
    lit = stage.lit(points, normals, point_light.position)
    toward, arriving = point_light.arriving(points, point_light.position, point_light.irradiance)
    cosine = (normals * toward).sum(dim=-1).clamp_min(0)
    return torch.where(lit, arriving * cosine, 0)
