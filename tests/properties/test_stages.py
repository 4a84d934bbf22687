"""Invariances of single stages on random inputs."""

import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.testing import assert_close

from pimper_bench.scenes.procedural_meshes import icosphere
from pimper_torch.linalg.robust import robust_variance
from pimper_torch.records import Mesh
from pimper_torch.stages.meshing.closing import closed
from pimper_torch.stages.meshing.simplify import simplify

SEEDS = st.integers(0, 2**31 - 1)


def drawn(seed: int, *shape: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@settings(max_examples=50, deadline=None)
@given(seed=SEEDS, gain=st.floats(1e-6, 1e6), size=st.integers(20, 9000))
def test_a_robust_variance_scales_with_data_and_ignores_their_order(seed, gain, size):
    square = drawn(seed, size).square()
    seen = torch.ones(size, dtype=torch.bool)
    usual = robust_variance(square, seen)
    order = torch.randperm(size, generator=torch.Generator().manual_seed(seed))
    assert_close(robust_variance(square[order], seen), usual)
    assert_close(robust_variance(gain * square, seen), gain * usual)


@settings(max_examples=40, deadline=None)
@given(seed=SEEDS, missing=st.floats(0.0, 0.7))
def test_any_missing_faces_of_a_ball_are_closed(seed, missing):
    vertices, faces = icosphere(2)
    chosen = torch.rand(len(faces), generator=torch.Generator().manual_seed(seed)) >= missing
    mesh = Mesh(vertices_world=vertices.double(), faces=faces[chosen])
    found = closed(mesh)
    solid = trimesh.Trimesh(found.mesh.vertices_world, found.mesh.faces, process=False)
    assert solid.is_watertight
    assert solid.is_winding_consistent
    assert int(found.measured.sum()) == len(mesh.faces)
    corners, before = (one.vertices_world[one.faces] for one in (found.mesh, mesh))
    assert torch.equal(corners[found.measured], before)


@settings(max_examples=20, deadline=None)
@given(seed=SEEDS, power=st.integers(-20, 20))
def test_simplification_does_not_depend_on_the_unit(seed, power):
    vertices, faces = icosphere(4)
    bumps = 1 + 0.05 * torch.cos(drawn(seed, 3) * 4 * vertices.double()).sum(dim=1, keepdim=True)
    mesh = Mesh(vertices_world=vertices.double() * bumps, faces=faces)
    usual = simplify(mesh)
    other = simplify(mesh.replace(vertices_world=2.0**power * mesh.vertices_world))
    assert torch.equal(other.mesh.faces, usual.mesh.faces)
    assert torch.equal(other.mesh.vertices_world, 2.0**power * usual.mesh.vertices_world)
    assert len(usual.mesh.faces) < len(faces)
