import pytest
import torch
from scenes import edge_counts
from surfaces import surface_of
from torch.nn.functional import normalize
from torch.testing import assert_close

from pimper_bench.scenes.procedural_meshes import icosphere
from pimper_torch.geometry.subdivision import subdivide
from pimper_torch.geometry.surfaces import barycentric_2d, face_normals, vertex_normals
from pimper_torch.geometry.topology import boundary_vertices
from pimper_torch.paper.cloud_filters import delaunay
from pimper_torch.records import CoarseMesh, FacetPoints, Mesh
from pimper_torch.runtime.errors import InputError
from pimper_torch.stages.coarse.coarse_config import RemeshConfig
from pimper_torch.stages.coarse.remesh import remesh

SPACING = 0.02


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(31)


def sheet(generator, side=7, lift=lambda xy: 0 * xy[:, 0]):
    """A square of irregular facets, counter-clockwise from above."""
    line = torch.linspace(-1, 1, side, dtype=torch.float64)
    y, x = torch.meshgrid(line, line, indexing="ij")
    xy = torch.stack([x, y], dim=-1).reshape(-1, 2)
    shake = 0.08 * torch.randn(xy.shape, generator=generator, dtype=torch.float64)
    xy = torch.where((xy.abs() < 0.99).all(dim=1, keepdim=True), xy + shake, xy)
    faces = delaunay(xy)
    vertices = torch.cat([xy, lift(xy)[:, None]], dim=1)
    up = face_normals(vertices, faces)[:, 2:] > 0
    return coarse_of(vertices, torch.where(up, faces, faces.flip(1)))


def coarse_of(vertices, faces):
    mesh = Mesh(vertices_world=vertices, faces=faces, normals_world=vertex_normals(vertices, faces))
    return CoarseMesh(mesh=mesh, reference=0, is_point=torch.zeros(len(vertices), dtype=torch.bool))


def surface_on(coarse, place, spacing=SPACING, normals=None, information=None):
    """Return the subdivision of a mesh with vertices moved by ``place``."""
    mesh = coarse.mesh
    count = len(mesh.faces)
    subdivision = subdivide(mesh.vertices_world, mesh.faces, torch.full((count,), spacing).double())
    points = place(subdivision.points)
    certain = 1e6 * torch.ones_like(points[:, 0])
    return surface_of(
        points,
        subdivision.faces,
        facet=subdivision.facet,
        barycentric=subdivision.barycentric,
        information=certain if information is None else information(subdivision),
        **({} if normals is None else {"normals_world": normals(points)}),
    )


def dome(points):
    """Place points on a plane with half a ball of radius 0.5 around (0.5, 0)."""
    offset = points[:, :2] - points.new_tensor([0.5, 0])
    height = (0.25 - offset.square().sum(dim=1)).clamp_min(0).sqrt()
    return torch.cat([points[:, :2], height[:, None]], dim=1)


def wavy(points):
    lift = 0.05 * torch.sin(9 * points[:, 0])
    return torch.cat([points[:, :2], points[:, 2:] + lift[:, None]], dim=1)


def test_children_of_a_facet_inherit_its_support(generator):
    coarse = sheet(generator)
    coarse = coarse.replace(support=torch.arange(len(coarse.mesh.faces)) % 4)
    found = remesh(coarse, surface_on(coarse, wavy), SPACING)
    assert len(found.mesh.faces) > len(coarse.mesh.faces)
    centre = found.mesh.vertices_world[found.mesh.faces].mean(dim=1)[:, :2]
    corners = coarse.mesh.vertices_world[coarse.mesh.faces][..., :2]
    place = barycentric_2d(centre[:, None], corners[None])
    parent = place.amin(dim=-1).argmax(dim=1)
    assert bool((found.support == coarse.support[parent]).all())


def test_a_mesh_that_fits_the_surface_is_unchanged(generator):
    coarse = sheet(generator, lift=lambda xy: 0.1 * xy[:, 0] * xy[:, 1])
    surface = surface_on(coarse, lambda points: points)
    found = remesh(coarse, surface, SPACING)
    assert_close(found.mesh.vertices_world, coarse.mesh.vertices_world)
    assert (found.mesh.faces == coarse.mesh.faces).all()
    again = remesh(found, surface_on(found, lambda points: points), SPACING)
    assert_close(again.mesh.vertices_world, found.mesh.vertices_world)


def test_a_mesh_is_refined_on_a_ball_but_not_on_a_plane(generator):
    coarse = sheet(generator, side=9)
    found = remesh(coarse, surface_on(coarse, dome), SPACING, RemeshConfig(min_samples=5.0))
    centres = coarse.mesh.vertices_world[coarse.mesh.faces].mean(dim=1)
    area = face_normals(found.mesh.vertices_world, found.mesh.faces)[:, 2] / 2
    where = found.mesh.vertices_world[found.mesh.faces].mean(dim=1)
    assert (area > 0).all()
    assert_close(area.sum(), area.new_tensor(4.0), atol=1e-6, rtol=0)  # the square, seen from above
    flat_before, flat_after = centres[:, 0] < -0.6, where[:, 0] < -0.6
    assert int(flat_before.sum()) == int(flat_after.sum()) > 5
    on_dome = (where[:, :2] - torch.tensor([0.5, 0])).norm(dim=1) < 0.45
    was_dome = (centres[:, :2] - torch.tensor([0.5, 0])).norm(dim=1) < 0.45
    assert int(on_dome.sum()) > 2 * int(was_dome.sum())


def test_all_vertices_are_on_the_surface(generator):
    coarse = sheet(generator, side=9)
    found = remesh(coarse, surface_on(coarse, dome), SPACING, RemeshConfig(min_samples=5.0))
    vertices = found.mesh.vertices_world
    assert len(vertices) > len(coarse.mesh.vertices_world)
    off = (vertices[:, 2] - dome(vertices)[:, 2]).abs()
    smooth = (vertices[:, :2] - torch.tensor([0.5, 0])).norm(dim=1) < 0.42
    # Between two points of an edge, a chord of length 0.02 is off by 0.02^2 / (8 * 0.5).
    assert off[smooth].max() < 1e-3
    truth = normalize(vertices - torch.tensor([0.5, 0, 0]), dim=1)
    inner = (vertices[:, :2] - torch.tensor([0.5, 0])).norm(dim=1) < 0.25
    assert inner.any()
    angle = (truth * found.mesh.normals_world).sum(dim=1)[inner].clamp(-1, 1).acos()
    assert torch.rad2deg(angle).max() < 3


def test_a_closed_mesh_stays_closed_and_approaches_the_ball(generator):
    vertices, faces = icosphere(1)
    coarse = coarse_of(vertices, faces)
    volume = (vertices[faces].det() / 6).sum()
    config = RemeshConfig(max_spread_deg=8.0)
    for _ in range(2):
        surface = surface_on(coarse, lambda points: normalize(points, dim=1))
        coarse = remesh(coarse, surface, SPACING, config)
        assert (edge_counts(coarse.mesh.faces)[1] == 2).all()
        grown = (coarse.mesh.vertices_world[coarse.mesh.faces].det() / 6).sum()
        assert volume < grown < 4 / 3 * torch.pi
        volume = grown
    assert len(coarse.mesh.faces) > 80
    # A mesh that is fine enough is not changed further.
    surface = surface_on(coarse, lambda points: normalize(points, dim=1))
    coarse = remesh(coarse, surface, SPACING, config)
    count = len(coarse.mesh.faces)
    surface = surface_on(coarse, lambda points: normalize(points, dim=1))
    assert len(remesh(coarse, surface, SPACING, config).mesh.faces) == count


def test_facets_with_a_high_residual_are_refined(generator):
    coarse = sheet(generator)
    residual = torch.full((len(coarse.mesh.faces),), 0.01).double()
    residual[0], residual[1] = 0.05, torch.nan
    surface = surface_on(coarse, lambda points: points)
    found = remesh(coarse, surface, SPACING, RemeshConfig(min_samples=4.0), residual=residual)
    added = len(found.mesh.faces) - len(coarse.mesh.faces)
    assert 3 <= added <= 12  # four of one, plus splits of neighbours
    corners = coarse.mesh.vertices_world[coarse.mesh.faces[0]]
    size = face_normals(found.mesh.vertices_world, found.mesh.faces).norm(dim=1)
    inside = found.mesh.vertices_world[found.mesh.faces].mean(dim=1) - corners.mean(dim=0)
    nearest = size[inside.norm(dim=1).argmin()]
    assert_close(nearest, torch.linalg.cross(*(corners[1:] - corners[0])).norm() / 4)


def test_small_facets_are_never_split_and_the_number_is_limited(generator):
    coarse = sheet(generator, side=9)
    surface = surface_on(coarse, dome)
    alone = remesh(coarse, surface, SPACING, RemeshConfig(min_samples=500.0))
    assert (alone.mesh.faces == coarse.mesh.faces).all()
    free = len(remesh(coarse, surface, SPACING, RemeshConfig(min_samples=5.0)).mesh.faces)
    limit = (len(coarse.mesh.faces) + free) // 2
    config = RemeshConfig(min_samples=5.0, max_facets=limit)
    limited = len(remesh(coarse, surface, SPACING, config).mesh.faces)
    assert limit - 12 <= limited <= limit


def test_facets_without_data_are_dropped_except_in_small_holes(generator):
    coarse = sheet(generator, side=9)
    centres = coarse.mesh.vertices_world[coarse.mesh.faces].mean(dim=1)
    hole = centres[:, :2].norm(dim=1).argsort()[:2]
    border = centres[:, 0] > 0.7

    def information(subdivision):
        inner = (subdivision.barycentric > 0).all(dim=1)
        lost = torch.isin(subdivision.facet, torch.cat([hole, border.nonzero()[:, 0]])) & inner
        return 1e6 * (~lost).double()

    surface = surface_on(coarse, lambda points: points, information=information)
    found = remesh(coarse, surface, SPACING)
    assert len(found.mesh.faces) == len(coarse.mesh.faces) - int(border.sum())
    strict = remesh(coarse, surface, SPACING, RemeshConfig(max_hole=0.0))
    assert len(strict.mesh.faces) == len(found.mesh.faces) - 2
    seen = border.clone()
    assert len(remesh(coarse, surface, SPACING, seen=seen).mesh.faces) == len(coarse.mesh.faces)
    dark = surface.replace(information=torch.zeros_like(surface.information))
    assert len(remesh(coarse, dark, SPACING).mesh.faces) == len(coarse.mesh.faces)
    assert boundary_vertices(found.mesh.faces, len(found.mesh.vertices_world)).any()


def test_points_are_reassigned_to_facets_and_no_vertex_is_a_point(generator):
    coarse = sheet(generator, side=9)
    count = 300
    facet = torch.randint(len(coarse.mesh.faces), (count,), generator=generator)
    inside = torch.distributions.Dirichlet(torch.ones(3).double()).sample((count,))
    corners = coarse.mesh.vertices_world[coarse.mesh.faces[facet]]
    places = (inside[:, :, None] * corners).sum(dim=1)
    spread = torch.rand(count, generator=generator, dtype=torch.float64)
    coarse = coarse.replace(
        covariance_world=torch.eye(3).double().expand(len(coarse.mesh.vertices_world), 3, 3),
        points=FacetPoints(
            points_world=places,
            covariance_world=spread[:, None, None] * torch.eye(3).double(),
            facet=facet,
        ),
    )
    found = remesh(coarse, surface_on(coarse, dome), SPACING, RemeshConfig(min_samples=5.0))
    new = found.mesh.vertices_world[found.mesh.faces[found.points.facet]][..., :2]
    here = found.points.points_world[..., :2]
    ahead = new.roll(-1, dims=1) - new
    to_point = here[:, None] - new
    side = ahead[..., 0] * to_point[..., 1] - ahead[..., 1] * to_point[..., 0]
    assert (side > -1e-6).all()  # inside its facet, as seen from above
    assert_close(found.points.points_world, places)
    assert_close(found.points.covariance_world[:, 0, 0], spread)
    assert not found.is_point.any()
    assert found.covariance_world is None


@pytest.mark.parametrize(("axes", "far"), [([0, 1], 0.7), ([2], 20.0)])
def test_an_outlying_vertex_makes_no_folds_and_needles(generator, axes, far):
    coarse = sheet(generator)
    surface = surface_on(coarse, lambda points: points)
    corner = (surface.barycentric > 0.999).any(dim=1).nonzero()[20, 0]
    ran = surface.vertices_world.clone()
    ran[corner, axes] += far
    found = remesh(coarse, surface.replace(vertices_world=ran), SPACING)
    assert (face_normals(found.mesh.vertices_world, found.mesh.faces)[:, 2] > 0).all()
    assert found.mesh.vertices_world[:, 2].abs().max() < 1e-9


def test_a_surface_of_a_different_mesh_is_rejected(generator):
    coarse, other = sheet(generator), sheet(generator, side=9)
    with pytest.raises(InputError, match="facets"):
        remesh(coarse, surface_on(other, lambda points: points), SPACING)
