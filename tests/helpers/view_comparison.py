"""Comparison of a mesh with exact maps along the rays of one view."""

from types import SimpleNamespace

import torch
from torch.nn.functional import normalize

from pimper_bench.metrics.in_view import angles_deg, meet_in_view, relative_error
from pimper_torch.geometry.rigid import rotate, transform
from pimper_torch.geometry.surfaces import vertex_normals


def compare_in_view(
    mesh, truth_from_world, cameras, view, depth_true, *, normals_true=None, where=None
):
    """Return 3D error in per cent, coverage, and angles between vertex and true normals."""
    vertices = mesh.vertices_world
    moved = mesh.replace(vertices_world=transform(truth_from_world.to(vertices), vertices))
    met = meet_in_view(moved, cameras, view, depth_true, where)
    angles = torch.full((1,), torch.nan)
    if normals_true is not None:
        own = mesh.normals_world
        own = vertex_normals(mesh.vertices_world, mesh.faces) if own is None else own
        found = normalize(met.interpolate(rotate(truth_from_world.to(own), own)).double(), dim=-1)
        angles = angles_deg(found, normals_true[met.both].double())
    return SimpleNamespace(
        relative_error=float(relative_error(met.points, met.points_true)),
        coverage=met.coverage,
        mean_angle_deg=float(angles.mean()),
        median_angle_deg=float(angles.median()),
        num_pixels=int(met.valid.sum()),
    )
