import torch
from torch.testing import assert_close

from pimper_bench.scenes.procedural_meshes import (
    lathe,
    mesh_level_set,
    rounded_cylinder,
    smooth_difference,
    smooth_union,
)
from pimper_bench.scenes.scene_objects import jar_mesh, mug_mesh
from pimper_torch.geometry.surfaces import face_normals
from pimper_torch.geometry.topology import half_edges


def euler(mesh):
    edges = half_edges(mesh.faces).sort(dim=1).values
    unique, counts = torch.unique(edges, dim=0, return_counts=True)
    assert (counts == 2).all()  # closed
    used = len(mesh.faces.unique())
    assert used == len(mesh.vertices_world)
    return used - len(unique) + len(mesh.faces)


def volume(mesh):
    a, b, c = mesh.vertices_world[mesh.faces].unbind(dim=1)
    return float((a * torch.linalg.cross(b, c)).sum()) / 6


def test_a_level_set_is_meshed_exactly_with_outward_normals():
    def sphere(points):
        return (points * points).sum(dim=-1) - 1  # its gradient is 2, not 1

    mesh = mesh_level_set(sphere, (-1.2, -1.3, -1.1), (1.2, 1.2, 1.2), 0.1)
    ones = torch.ones(len(mesh.vertices_world), dtype=torch.float64)
    assert_close(mesh.vertices_world.norm(dim=1), ones)
    assert_close(mesh.normals_world, mesh.vertices_world)
    assert euler(mesh) == 2
    assert 0.98 < volume(mesh) / (4 / 3 * torch.pi) < 1  # positive: faces outward


def test_a_cylinder_with_round_edges_has_its_distance():
    points = torch.tensor([[0.0, 0, 0.5], [2, 0, 0.5], [0, 0, 1.4], [1.0, 0, 1.0]]).double()
    found = rounded_cylinder(points, radius=1.0, low=0.0, high=1.0, rounding=0.25)
    # The rim's corner is rounded: sqrt(2) - 1 times the radius away.
    expected = torch.tensor([-0.5, 1.0, 0.4, 0.25 * (2**0.5 - 1)]).double()
    assert_close(found, expected, atol=1e-7, rtol=0)


def test_smooth_joins_differ_from_sharp_ones_only_near_the_seam():
    first, second = torch.tensor([0.0, 0.1, -0.4]), torch.tensor([0.0, 0.4, 0.3])
    assert_close(smooth_union(first, second, 0.2), torch.tensor([-0.05, 0.1, -0.4]))
    cut = smooth_difference(first, second, 0.2)
    assert_close(cut, torch.tensor([0.05, 0.1, -0.2875]))


def test_a_mug_is_one_closed_solid_with_one_handle_on_the_table():
    mesh = mug_mesh(cell=0.04)
    assert euler(mesh) == 0  # a torus, with any bulges
    normals = face_normals(mesh.vertices_world, mesh.faces)
    agree = (normals[:, None] * mesh.normals_world[mesh.faces]).sum(dim=-1) > 0
    assert agree.float().mean() > 0.999
    assert 0.5 < volume(mesh) < 2  # a wall, not a block of 4.4
    assert abs(float(mesh.vertices_world[:, 2].min())) < 1e-6


def test_a_jar_is_closed_and_round():
    mesh = jar_mesh(levels=60, around=48)
    assert euler(mesh) == 2
    assert volume(mesh) > 2
    assert mesh.vertices_world[:, 2].min() == 0
    assert mesh.vertices_world[:, :2].mean(dim=0).norm() < 1e-9


def test_a_solid_of_revolution_has_the_volume_of_pappus():
    profile = torch.tensor([[0.0, 0.0], [1.0, 0.0], [1.0, 2.0], [0.0, 2.0]]).double()
    assert_close(volume(lathe(profile, around=400)), 2 * torch.pi, rtol=1e-3, atol=0)
