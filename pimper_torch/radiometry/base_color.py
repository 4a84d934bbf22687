"""Colours of meshes for display and for files."""

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.records import Mesh

GREY = 0.5
"""Base colour of a mesh of unknown albedo."""


def albedo_scale(mesh: Mesh) -> float:
    """Return the factor that scales a mesh's albedo, known up to a scale, to [0, 1].

    It scales the 99th percentile of the brightest channel to 0.9, because highlights may have
    corrupted brighter vertices. Vertices with a confidence of at most a half do not count, if there
    are others: grazing views make them up to ten times as bright.
    """
    if mesh.albedo is None or not len(mesh.albedo):
        return 1.0
    brightest = mesh.albedo.detach().amax(dim=-1).nan_to_num(0)
    if mesh.confidence is not None and bool((sure := mesh.confidence > 0.5).any()):
        brightest = brightest[sure]
    positive = brightest[brightest > 0]
    if not len(positive):
        return 1.0
    rank = max(1, round(0.99 * len(positive)))
    return float(0.9 / positive.kthvalue(rank).values)


def base_color(mesh: Mesh, scale: float | None = None) -> Float[Tensor, "vertex channel"]:
    """Return a mesh's linear albedo in [0, 1], glTF's base colour; grey without albedo.

    Args:
        scale: Of the albedo; by default :func:`albedo_scale`.
    """
    if mesh.albedo is None:
        return torch.full_like(mesh.vertices_world, GREY)
    scale = albedo_scale(mesh) if scale is None else scale
    return (scale * mesh.albedo.detach()).nan_to_num(0).clamp(0, 1)
