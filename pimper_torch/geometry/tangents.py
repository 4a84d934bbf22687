"""Tangent frames of normal maps, as viewers compute them."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.geometry.visibility import Hits
from pimper_torch.records.shapes import Faces, Vertices


def vertex_tangents(
    vertices: Vertices, normals: Vertices, uv: Float[Tensor, "vertex 2"], faces: Faces
) -> Float[Tensor, "vertex 4"]:
    """Return glTF's tangents: unit, perpendicular to the normal, along ``u``; then a sign.

    The sign times the cross product of normal and tangent points up in the image, against ``v``;
    it is -1 where the texture is mirrored on the surface. Directions of a vertex's faces are
    weighted by their area on the texture.

    Args:
        uv: Right and down over the texture.
    """
    a, b, c = vertices[faces].unbind(dim=1)
    p, q, r = (uv * uv.new_tensor([1.0, -1.0]))[faces].unbind(dim=1)
    first, second = q - p, r - p
    area = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    along = (b - a) * second[:, 1:] - (c - a) * first[:, 1:]
    along = along * area.sign()[:, None]
    corners = faces.mT.flatten()
    total = torch.zeros_like(vertices).index_add(0, corners, along.repeat(3, 1))
    signed = torch.zeros_like(vertices[:, 0]).index_add(0, corners, area.repeat(3))
    across = total - (total * normals).sum(dim=1, keepdim=True) * normals
    # Where faces have no area on the texture, use any direction along the surface.
    axis = torch.eye(3).to(normals)[normals.abs().argmin(dim=1)]
    lost = across.norm(dim=1, keepdim=True) <= 1e-6 * total.norm(dim=1, keepdim=True)
    across = torch.where(lost, torch.linalg.cross(normals, axis), across)
    sign = torch.where(signed < 0, -1.0, 1.0)
    return torch.cat([normalize(across, dim=1, eps=0), sign[:, None]], dim=1)


def frames(
    hits: Hits, normals: Vertices, tangent: Float[Tensor, "vertex 4"], faces: Faces
) -> Float[Tensor, "*batch 3 3"]:
    """Return tangent, bitangent and normal as columns, interpolated over faces as in shaders.

    Khronos' viewer and three.js interpolate and normalize each of the three separately; they are
    then not exactly perpendicular.
    """
    along, sign = tangent[:, :3], tangent[:, 3:]
    axes = (along, sign * torch.linalg.cross(normals, along), normals)
    return torch.stack([normalize(hits.interpolate(axis, faces), dim=-1) for axis in axes], dim=-1)
