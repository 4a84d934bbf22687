"""Albedo where light does not determine it."""

import torch

from pimper_torch.geometry.topology import face_edges, vertex_components
from pimper_torch.linalg.continuation import about_mean
from pimper_torch.records import Mesh
from pimper_torch.records.shapes import PerVertex

# Confidence of normals that are off by 24 degrees. A choice.
_LEAST_CONFIDENCE = 0.1

UNDETERMINED, INPAINTED = 0.5, 1.0
"""Uncertainty of the albedo of a vertex or texel; 0 where light determines it."""


def inpainted(mesh: Mesh) -> tuple[Mesh, PerVertex]:
    """Replace implausibly bright albedo by that of the neighbours.

    Where few lights reach the surface, normals are undetermined, and with them the shading by which
    radiance was divided. Such a vertex is too bright if it is brighter than 99 of 100 determined
    ones; so are its surroundings where they exceed the albedo continued from determined surface.

    Returns:
        The mesh, unchanged if nothing is too bright or confidence is missing, and the uncertainty.
    """
    albedo, confidence = mesh.albedo, mesh.confidence
    if albedo is None or confidence is None:
        return mesh, torch.zeros_like(mesh.vertices_world[:, 0])
    finite = albedo.isfinite().all(dim=1)
    sure = (confidence >= _LEAST_CONFIDENCE) & finite
    uncertainty = torch.where(sure, 0.0, UNDETERMINED).to(albedo)
    if not bool(sure.any()):
        return mesh, uncertainty
    edges, _ = face_edges(mesh.faces)
    brightness = albedo.amax(dim=1)
    usual = about_mean(albedo, sure, edges).amax(dim=1)
    most = brightness[sure].kthvalue(max(1, round(0.99 * int(sure.sum())))).values
    above = ~sure & (brightness > usual)
    label = vertex_components(mesh.faces, above)
    bright = above & torch.isin(label, label[above & (brightness > most)]) | ~finite
    if not bool(bright.any()):
        return mesh, uncertainty
    continued = mesh.replace(albedo=about_mean(albedo, ~bright, edges))
    return continued, torch.where(bright, INPAINTED, uncertainty)
