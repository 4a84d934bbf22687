import torch
from scenes import CORNERS, FACETS
from surfaces import surface_of
from torch.nn.functional import normalize
from torch.testing import assert_close

from pimper_torch.geometry.surfaces import barycentric_2d, vertex_normals
from pimper_torch.geometry.topology import face_edges
from pimper_torch.records import Mesh
from pimper_torch.stages.coarse.splitting import fitted_normals, split_edges


def square():
    """Return two facets, and their subdivision with halved edges."""
    edges, _ = face_edges(FACETS)
    split = split_edges(CORNERS, FACETS, torch.ones(len(edges), dtype=torch.bool))
    fine = torch.cat([CORNERS, CORNERS[edges[split.halved]].mean(dim=1)])
    return CORNERS, FACETS, split, fine


def on_facets(vertices, faces, count, generator, normal):
    """Return a surface of points on facets, with normals as a function of position."""
    facet = torch.randint(len(faces), (count,), generator=generator)
    barycentric = torch.rand(count, 3, generator=generator, dtype=torch.float64)
    barycentric = barycentric / barycentric.sum(dim=1, keepdim=True)
    points = (barycentric[:, None] @ vertices[faces[facet]])[:, 0]
    return surface_of(
        points,
        torch.zeros(0, 3, dtype=torch.long),
        facet=facet,
        barycentric=barycentric,
        normals_world=normal(points),
        information=100 * torch.rand(count, generator=generator, dtype=torch.float64),
    )


def test_inherited_normals_are_a_weighted_least_squares_fit(generator):
    vertices, faces, split, fine = square()

    def bent(points):
        noise = 0.2 * torch.randn(points.shape, generator=generator, dtype=torch.float64)
        return normalize(points.new_tensor([0, 0, 1]) + 0.5 * points.sin() + noise, dim=1)

    surface = on_facets(vertices, faces, 500, generator, bent)
    index = torch.arange(len(split.faces))
    mesh = Mesh(vertices_world=fine, faces=split.faces)
    found = fitted_normals(mesh, surface, split, index)
    # A dense solve; coordinates of each point in the children, in the plane of the square.
    flat = fine[split.faces][..., :2]
    inside = barycentric_2d(surface.vertices_world[:, None, :2], flat[None])
    child = inside.amin(dim=-1).argmax(dim=1)
    blend = torch.zeros(len(child), len(fine), dtype=torch.float64)
    weights = inside[torch.arange(len(child)), child]
    blend.scatter_(1, split.faces[child], weights)
    own = vertex_normals(fine, split.faces)
    weight = (surface.confidence + 0.05)[:, None]  # confidence plus a twentieth
    matrix = blend.mT @ (weight * blend)
    damping = 0.01 * matrix.diagonal().mean()  # weight of the facets' own normals
    damped = matrix + damping * torch.eye(len(fine)).double()
    right = blend.mT @ (weight * surface.normals_world) + damping * own
    assert_close(found, normalize(torch.linalg.solve(damped, right), dim=1))
    assert float(torch.rad2deg((found * own).sum(dim=1).clamp(-1, 1).acos()).max()) > 10


def test_facets_without_surface_vertices_keep_their_own_normals(generator):
    vertices, faces, split, fine = square()
    surface = on_facets(
        vertices,
        faces,
        500,
        generator,
        lambda points: points.new_tensor([0.6, 0, 0.8]) + 0 * points,
    )
    kept = split.parent == 0
    index = torch.where(kept, kept.cumsum(dim=0) - 1, -1)
    surface = surface.take(surface.facet == 1)  # only on the dropped facet
    mesh = Mesh(vertices_world=fine, faces=split.faces[kept])
    found = fitted_normals(mesh, surface, split, index)
    used = torch.unique(mesh.faces)
    assert_close(found[used], torch.tensor([0.0, 0, 1]).double().expand(len(used), 3))
