import pytest
import torch
from draws import normal
from scipy.spatial import Delaunay
from torch.testing import assert_close

from pimper_torch.geometry.finite_elements import cotangent_laplacian, elements, lumped_mass
from pimper_torch.geometry.topology import boundary_vertices
from pimper_torch.linalg.multigrid import Multigrid
from pimper_torch.linalg.sparse import SparseCholesky
from pimper_torch.linalg.systems import prepare_system


def square(count, generator, jitter=0.25):
    """Return a triangulated unit square with jittered inner vertices."""
    side = torch.linspace(0, 1, count + 1, dtype=torch.float64)
    places = torch.stack(torch.meshgrid(side, side, indexing="xy"), dim=-1).reshape(-1, 2)
    inner = ((places > 0) & (places < 1)).all(dim=1, keepdim=True)
    places = places + inner * jitter / count * normal(generator, *places.shape).clamp(-1, 1)
    faces = torch.from_numpy(Delaunay(places.numpy()).simplices).long()
    return torch.cat([places, torch.zeros(len(places), 1).double()], dim=1), faces


def bent(vertices):
    x, y, _ = vertices.unbind(dim=1)
    return torch.stack([x, y, 0.4 * torch.sin(3 * x) * y], dim=1)


def dense(rows, cols, values, size):
    return torch.zeros(size, size).to(values).index_put((rows, cols), values, accumulate=True)


@pytest.fixture
def surface(generator):
    vertices, faces = square(7, generator)
    return bent(vertices), faces


def test_the_laplacian_is_the_inner_product_of_weighted_gradients(surface, generator):
    vertices, faces = surface
    mesh = elements(vertices, faces)
    weight = torch.rand(len(faces), generator=generator, dtype=torch.float64)
    one, other = normal(generator, mesh.count, 2).unbind(dim=1)
    matrix = dense(*cotangent_laplacian(mesh, weight), mesh.count)
    assert_close(matrix, matrix.T)
    edges = vertices[faces].diff(dim=1)
    area = torch.linalg.cross(*edges.unbind(dim=1)).norm(dim=1) / 2
    along = torch.linalg.pinv(edges)
    slopes = [(along @ u[faces].diff(dim=1)[..., None])[..., 0] for u in (one, other)]
    inner = (weight * area * (slopes[0] * slopes[1]).sum(dim=1)).sum()
    assert_close(one @ matrix @ other, inner)
    assert torch.linalg.eigvalsh(matrix)[1] > 1e-6  # only the constant is free


def test_entries_are_half_the_cotangents_of_the_angles_opposite_to_an_edge():
    angles = torch.deg2rad(torch.tensor([50.0, 60.0, 70.0], dtype=torch.float64))
    # The law of sines gives the edges; the third corner follows.
    b, c = angles[1].sin(), angles[2].sin()
    flat = torch.stack([0 * c, 0 * c, c, 0 * c, b * angles[0].cos(), b * angles[0].sin()])
    vertices = torch.nn.functional.pad(flat.reshape(3, 2), (0, 1))
    mesh = elements(vertices, torch.tensor([[0, 1, 2]]))
    matrix = dense(*cotangent_laplacian(mesh, torch.ones(1).double()), 3)
    half = 0.5 / angles.tan()
    assert_close(matrix[[1, 0, 0], [2, 2, 1]], -half)
    assert_close(matrix.sum(dim=1), torch.zeros(3, dtype=torch.float64), atol=1e-14, rtol=0)


def test_cotangents_of_needles_are_bounded():
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0.5, 1e-9, 0]], dtype=torch.float64)
    mesh = elements(vertices, torch.tensor([[0, 1, 2]]))
    _, _, sharp = cotangent_laplacian(mesh, torch.ones(1).double())
    _, _, blunt = cotangent_laplacian(mesh, torch.ones(1).double(), min_shape=1e-4)
    assert sharp.abs().max() > 1e8
    assert blunt.abs().max() <= 0.25e4 * (1 + 1e-12)


def test_vertex_masses_sum_to_the_mass_of_the_surface(surface):
    mesh = elements(*surface)
    density = torch.linspace(1, 2, len(mesh.faces), dtype=torch.float64)
    assert_close(lumped_mass(mesh, density).sum(), (density * mesh.area).sum())
    one = torch.zeros_like(density)
    one[3] = 1
    assert (lumped_mass(mesh, one) > 0).nonzero()[:, 0].tolist() == sorted(mesh.faces[3].tolist())


@pytest.mark.parametrize("kind", [SparseCholesky, Multigrid])
def test_the_error_of_a_poisson_problem_falls_as_the_spacing_squared(kind, generator):
    """Harmonic heights from their boundary values, on irregular triangles."""
    errors = []
    for count in (12, 24, 48):
        vertices, faces = square(count, generator)
        mesh = elements(vertices, faces)
        x, y, _ = vertices.unbind(dim=1)
        wanted = torch.exp(2 * x) * torch.sin(2 * y)
        on_border = boundary_vertices(faces, mesh.count)
        weights = torch.ones(len(faces), dtype=torch.float64)
        rows, cols, values = cotangent_laplacian(mesh, weights)
        anchor = 1e8 * on_border.double()
        index = torch.arange(mesh.count)
        system = kind(
            torch.cat([rows, index]),
            torch.cat([cols, index]),
            torch.cat([values, anchor]),
            mesh.count,
        )
        found = system.solve(anchor * wanted)
        errors.append(float((found - wanted).abs().max()))
    assert errors[0] / errors[2] > 8  # 16 for nested meshes; these are drawn independently


def test_gradients_reach_weights_and_vertices(generator):
    vertices, faces = square(2, generator)
    vertices = bent(vertices).requires_grad_()
    weight = (0.5 + torch.rand(len(faces), generator=generator).double()).requires_grad_()
    anchor = torch.full((len(vertices),), 0.3, dtype=torch.float64)
    rhs = normal(generator, len(vertices))

    def solution(vertices, weight):
        mesh = elements(vertices, faces)
        rows, cols, values = cotangent_laplacian(mesh, weight)
        index = torch.arange(mesh.count)
        entries = torch.cat([values, lumped_mass(mesh, weight) + anchor])
        whole = torch.cat([rows, index]), torch.cat([cols, index]), entries
        return prepare_system(*whole, mesh.count).solve(rhs)

    assert torch.autograd.gradcheck(solution, [vertices, weight])
