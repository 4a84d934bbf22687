"""Fusion by overlapping blocks against complete fusion, on a spherical cap of 96 facets."""

import pytest
import torch
from torch.testing import assert_close

from pimper_torch.geometry.subdivision import subdivide
from pimper_torch.geometry.topology import face_counts, face_edges
from pimper_torch.records import Mesh
from pimper_torch.stages.fusion.blocks import Coarse, block_of, partitioned, pooled
from pimper_torch.stages.fusion.fuse import Fuse
from tests.fusion.test_sphere import cap_of, free, noisy, off_sphere
from tests.threads import on_threads

MOST = 600.0


@pytest.fixture(scope="module")
def drawn():
    return noisy(cap_of(4), 0.05, 0.3, torch.Generator().manual_seed(5))


@pytest.fixture(scope="module")
def ball():
    """A closed surface: an octahedron with three 1-to-4 subdivisions."""
    corners = torch.cat([torch.eye(3), -torch.eye(3)]).double()
    faces = torch.tensor([[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2]])
    faces = torch.cat([faces, torch.tensor([[1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]])])
    for _ in range(3):
        halved = subdivide(corners, faces, torch.full((len(faces),), 1e-9).double() + 0.71)
        corners, faces = halved.points * 2, halved.faces
    mesh = Mesh(vertices_world=corners, faces=faces)
    return mesh, subdivide(corners, faces, torch.full((len(faces),), 0.4).double())


def test_blocks_partition_a_closed_surface(ball):
    mesh, whole = ball
    parts = partitioned(whole, mesh, len(whole.points) / 3)
    assert len(parts) > 3
    assert (torch.stack(parts).sum(dim=0) == 1).all()
    owners = torch.zeros(len(whole.points), dtype=torch.long)
    weights = torch.zeros(len(whole.points), dtype=torch.float64)
    faces = []
    for mine in parts:
        block = block_of(whole, mesh.faces, mine, Coarse(subdivision=whole))
        part = block.subdivision
        assert torch.equal(part.points, whole.points[block.vertex])
        assert not (block.weight[block.held] > 0).any()
        assert (block.weight[block.own] > 0).all()
        owners[block.vertex[block.own]] += 1
        weights.index_add_(0, block.vertex, block.weight)
        faces.append(block.vertex[part.faces[mine[part.face_facet]]])
    assert (owners == 1).all()
    assert_close(weights, torch.ones_like(weights))
    joined = torch.cat(faces)
    assert (face_counts(face_edges(joined)[1]) == 2).all()
    assert torch.equal(
        joined[joined[:, 0].argsort(stable=True)].sort(dim=0).values, whole.faces.sort(dim=0).values
    )


def test_fusion_by_blocks_matches_the_complete_one_within_noise(drawn):
    fuse = Fuse()
    whole, blocks = fuse(drawn, free()), fuse(drawn, free(), True, MOST)
    assert torch.equal(whole.faces, blocks.faces)
    assert torch.equal(whole.information, blocks.information)
    off = (whole.vertices_world - blocks.vertices_world).norm(dim=1) / whole.expected_error
    assert off.max() > 0  # there are several blocks
    assert off.square().mean().sqrt() < 0.2
    assert off.max() < 1
    true = off_sphere(whole.vertices_world), off_sphere(blocks.vertices_world)
    assert true[1].square().mean() < 1.1 * true[0].square().mean()


def test_blocks_are_bitwise_reproducible_on_any_number_of_threads(drawn):
    one, two = on_threads(lambda: Fuse()(drawn, free(), True, MOST), 1, 2)
    assert torch.equal(one.vertices_world, two.vertices_world)
    assert torch.equal(one.albedo, two.albedo)


def test_gradients_propagate_through_blocks(drawn):
    heights = tuple(
        found.replace(offset=found.offset.clone().requires_grad_()) for found in drawn.buckets
    )
    found = []
    for most in (float("inf"), MOST):
        surface = Fuse()(drawn.replace(buckets=heights), free(), False, most)
        inputs = [bucket.offset for bucket in heights]
        found.append(torch.autograd.grad(surface.vertices_world[:, 2].sum(), inputs))
    for whole, blocks in zip(*found, strict=True):
        assert_close(whole.sum(), blocks.sum(), rtol=0.05, atol=0)


def test_noise_is_the_mean_of_blocks_with_enough_equations():
    one, three = torch.tensor(1.0), torch.tensor(3.0)
    found = pooled([{(0, 0): (300, one), (1, 0): (5, one)}, {(0, 0): (900, three)}])
    assert found == {(0, 0): torch.tensor(2.5)}
