"""Surfaces like those of fusion, with defaults for all fields that a test does not set."""

import torch

from pimper_torch.geometry.surfaces import vertex_normals
from pimper_torch.records import Convergence, Surface


def surface_of(vertices, faces, **known):
    """Return a converged surface; by default white, of one facet, with normals of its faces."""
    one = torch.ones_like(vertices[:, 0])
    if "normals_world" not in known:
        known["normals_world"] = vertex_normals(vertices, faces)
    fields = {
        "facet": torch.zeros(len(vertices), dtype=torch.long),
        "barycentric": torch.full_like(vertices, 1 / 3),
        "albedo": torch.ones_like(vertices),
        "information": one,
        "height_information": torch.zeros_like(one),
        "convergence": Convergence(
            iterations=torch.ones(1, dtype=torch.long),
            residual=torch.zeros(1).to(one),
            cause=torch.zeros(1, dtype=torch.long),
        ),
    }
    return Surface(vertices_world=vertices, faces=faces, **fields | known)
