import pytest
import torch

from pimper_bench.scenes.procedural_meshes import icosphere
from pimper_torch.geometry.topology import boundary_loops
from pimper_torch.stages.coarse.welding import TOLERANCE, welded


def soup(vertices, faces):
    """Give every face its own vertices, as in STL."""
    return vertices[faces].reshape(-1, 3), torch.arange(3 * len(faces)).reshape(-1, 3)


def triangles(vertices, faces):
    return sorted(vertices[faces].flatten(1).tolist())


@pytest.mark.parametrize("offset", [0.0, 5e6])
def test_welding_a_triangle_soup_restores_the_surface(offset):
    vertices, faces = icosphere(3)
    vertices = vertices + offset
    found, joined = welded(*soup(vertices, faces))
    assert len(found) == len(vertices)
    assert triangles(found, joined) == triangles(vertices, faces)
    assert len(boundary_loops(joined)[0]) == 0


@pytest.mark.parametrize(("gap", "seams"), [(0.4 * TOLERANCE, False), (10 * TOLERANCE, True)])
def test_rounding_is_welded_and_narrow_gaps_are_not(gap, seams):
    """The seam crosses cells of any grid: its sides are merged in every position."""
    vertices, faces = icosphere(3)
    vertices = vertices.float().double()
    apart, single = soup(vertices, faces)
    diagonal = float((vertices.amax(dim=0) - vertices.amin(dim=0)).norm())
    generator = torch.Generator().manual_seed(8)
    noise = torch.rand(apart.shape, generator=generator, dtype=torch.float64) / 3**0.5
    found, joined = welded(apart + gap * diagonal * noise, single)
    assert (len(found) > len(vertices)) == seams
    assert (len(boundary_loops(joined)[0]) > 0) == seams


def test_a_welded_mesh_only_loses_unused_vertices():
    vertices, faces = icosphere(2)
    found, joined = welded(torch.cat([vertices, vertices[:1] + 9]), faces)
    assert torch.equal(found, vertices)
    assert torch.equal(joined, faces)


def test_surfaces_touching_in_a_vertex_share_it():
    vertices, faces = icosphere(1)
    top = vertices[:, 2].argmax()
    other = -vertices + 2 * vertices[top]
    found, _ = welded(torch.cat([vertices, other]), torch.cat([faces, faces + len(vertices)]))
    assert len(found) == 2 * len(vertices) - 1


def test_a_mesh_collapsed_to_a_point_has_one_vertex():
    found, joined = welded(torch.ones(6, 3), torch.arange(6).reshape(2, 3))
    assert len(found) == 1
    assert (joined == 0).all()
