import pytest
import torch
from torch.testing import assert_close

from pimper_bench.baselines.smoothed import Smoothed
from pimper_bench.scenes.procedural_meshes import icosphere
from pimper_torch.runtime.errors import ReconstructionError


@pytest.fixture(autouse=True)
def _few(monkeypatch):
    monkeypatch.setattr(f"{Smoothed.__module__}._NUM_VERTICES", 3000)


@pytest.mark.parametrize("shape", ["sphere", "bumps"])
def test_the_smooth_surface_is_more_accurate_than_the_facets(
    shape, photographed, compared, request
):
    truth, scene, coarse = photographed(request.getfixturevalue(shape))
    facets = compared(coarse.mesh.replace(normals_world=None), truth, coarse)
    smooth = compared(Smoothed()(scene, coarse).mesh, truth, coarse)
    assert smooth.relative_error < 0.75 * facets.relative_error  # measured 0.41 and 0.66
    assert smooth.median_angle_deg < 0.85 * facets.median_angle_deg  # 0.79 and 0.45
    assert smooth.coverage > facets.coverage - 0.01


def test_a_flat_mesh_is_unchanged(photographed, sphere):
    _, scene, coarse = photographed(sphere)
    flat = coarse.mesh.vertices_world @ torch.diag(torch.tensor([1.0, 1.0, 0.0]))
    level = coarse.replace(mesh=coarse.mesh.replace(vertices_world=flat))
    found = Smoothed()(scene, level).mesh
    assert found.vertices_world[:, 2].abs().max() < 1e-5
    low, high = flat[coarse.mesh.faces.unique()].aminmax(dim=0)
    assert_close(found.vertices_world.amin(dim=0), low, atol=0.02, rtol=0)  # rounded corners
    assert_close(found.vertices_world.amax(dim=0), high, atol=0.02, rtol=0)


def test_a_closed_mesh_becomes_rounder(photographed, sphere):
    _, scene, coarse = photographed(sphere)
    vertices, faces = icosphere(1)
    ball = coarse.replace(
        mesh=coarse.mesh.replace(vertices_world=vertices.float(), faces=faces, normals_world=None),
        is_point=torch.ones(len(vertices), dtype=torch.bool),
        covariance_world=None,
        points=None,
    )
    found = Smoothed()(scene, ball).mesh
    corners = vertices[faces]
    facets_miss = (corners.mean(dim=1).norm(dim=-1) - 1).abs().mean()
    assert (found.vertices_world.norm(dim=-1) - 1).abs().mean() < 0.3 * facets_miss
    assert (found.normals_world * found.vertices_world).sum(dim=-1).min() > 0.95  # outward


def test_more_fidelity_passes_closer_to_the_points(photographed, bumps, monkeypatch):
    _, scene, coarse = photographed(bumps)
    points = coarse.mesh.vertices_world[coarse.mesh.faces.unique()]
    missed = []
    for fidelity in (1.0, 100.0, 10000.0):
        monkeypatch.setattr(f"{Smoothed.__module__}._FIDELITY", fidelity)
        found = Smoothed()(scene, coarse).mesh
        missed.append(torch.cdist(points, found.vertices_world).amin(dim=1).max())
    assert missed[0] > 3 * missed[1] > 9 * missed[2]


def test_a_mesh_without_facets_is_refused(photographed, sphere):
    _, scene, coarse = photographed(sphere)
    empty = coarse.replace(mesh=coarse.mesh.replace(faces=coarse.mesh.faces[:0]))
    with pytest.raises(ReconstructionError, match="no facets"):
        Smoothed()(scene, empty)
