import pytest
import torch
from scenes import CORNERS, FACETS, edge_counts, subdivided_square
from torch.testing import assert_close

from pimper_bench.scenes.procedural_meshes import icosphere
from pimper_torch.geometry.subdivision import Subdivision, subdivide, transferred
from pimper_torch.geometry.surfaces import face_normals


def ragged_fan(seed=41):
    """Return an open fan of triangles with edge lengths that differ twentyfold."""
    generator = torch.Generator().manual_seed(seed)
    count = 9
    angle = torch.arange(count, dtype=torch.float64) * (2 * torch.pi / count)
    radius = 0.1 + 1.9 * torch.rand(count, generator=generator, dtype=torch.float64)
    height = 0.3 * torch.randn(count, generator=generator, dtype=torch.float64)
    rim = torch.stack([radius * angle.cos(), radius * angle.sin(), height], dim=1)
    vertices = torch.cat([torch.zeros(1, 3, dtype=torch.float64), rim])
    one = torch.arange(count)
    return vertices, torch.stack([torch.zeros_like(one), 1 + one, 1 + (one + 1) % count], dim=1)


def euler(num_vertices, faces):
    return num_vertices - len(edge_counts(faces)[0]) + len(faces)


def all_spacings(facets, length):
    """Return equal or alternating spacings of facets."""
    lengths = torch.as_tensor(length, dtype=torch.float64).flatten()
    return lengths.repeat(len(facets))[: len(facets)]


SCENES = {
    "closed": (*icosphere(1), 0.08),
    "ragged": (*ragged_fan(), 0.05),
    "ragged, coarse": (*ragged_fan(seed=42), 0.7),
    "one piece an edge": (*icosphere(0), 5.0),
    "unlike spacings": (*icosphere(1), [0.05, 0.2, 0.1, 0.4, 0.07]),
    "one piece beside many": (*icosphere(0), [5.0, 0.1, 0.03]),
    "ragged, unlike spacings": (*ragged_fan(), [0.05, 0.4]),
    "sliver with 1, 1 and 2 pieces": (
        torch.tensor([[0.0, 0.1, 0], [-0.76, 0, 0], [0.76, 0, 0]], dtype=torch.float64),
        torch.tensor([[1, 2, 0]]),
        1.0,
    ),
}


@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES.keys())
def test_the_subdivided_mesh_has_the_topology_of_the_coarse_mesh(scene):
    vertices, facets, length = scene
    subdivision = subdivide(vertices, facets, all_spacings(facets, length))
    assert subdivision.faces.unique().tolist() == list(range(len(subdivision.points)))
    assert euler(len(subdivision.points), subdivision.faces) == euler(len(vertices), facets)
    _, counts = edge_counts(subdivision.faces)
    assert counts.max() <= 2
    if edge_counts(facets)[1].min() == 2:
        assert counts.min() == 2
    else:  # the boundary is divided, not moved: its length is that of the coarse one

        def rim(points, faces):
            ends, number = edge_counts(faces)
            return (points[ends[number == 1]].diff(dim=1)).norm(dim=-1).sum()

        assert_close(rim(subdivision.points, subdivision.faces), rim(vertices, facets))


@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES.keys())
def test_no_face_is_flipped_and_areas_add_up(scene):
    vertices, facets, length = scene
    subdivision = subdivide(vertices, facets, all_spacings(facets, length))
    normals, whole = (
        face_normals(subdivision.points, subdivision.faces),
        face_normals(vertices, facets),
    )
    along = torch.nn.functional.normalize(whole, dim=-1)[subdivision.face_facet]
    assert ((normals * along).sum(-1) > 1e-6 * min(all_spacings(facets, length)) ** 2).all()
    areas = whole.new_zeros(len(facets)).index_add(0, subdivision.face_facet, normals.norm(dim=-1))
    assert_close(areas, whole.norm(dim=-1))


def test_edges_are_about_one_spacing_long_where_facets_are_well_shaped():
    vertices, facets = icosphere(1)
    subdivision = subdivide(vertices, facets, all_spacings(facets, 0.05))
    edges, _ = edge_counts(subdivision.faces)
    lengths = subdivision.points[edges].diff(dim=1).norm(dim=-1)
    assert 0.9 < float(lengths.median()) / 0.05 < 1.1
    assert float(lengths.max()) < 2 * 0.05


def test_the_number_of_points_of_a_narrow_facet_follows_its_area():
    spacing = 0.005
    for height in (1.0, 0.3, 0.1, 0.03):
        corners = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0.4, height, 0]], dtype=torch.float64)
        subdivision = subdivide(corners, torch.tensor([[0, 1, 2]]), corners.new_tensor([spacing]))
        asked = height / 2 / spacing**2
        assert 0.9 * asked < len(subdivision.points) < 2.3 * asked  # 2, plus the boundary


def test_an_edge_follows_the_finer_of_its_facets():
    subdivision = subdivide(CORNERS, FACETS, torch.tensor([0.05, 0.5], dtype=torch.float64))
    coordinate = subdivision.points[:, 0]
    on_diagonal = (subdivision.points[:, 0] - subdivision.points[:, 1]).abs() < 1e-9
    on_top = subdivision.points[:, 1] > 1 - 1e-9
    assert on_diagonal.sum() == 29  # sqrt(2) / 0.05 pieces
    assert on_top.sum() == 3
    assert coordinate.isfinite().all()
    edges, counts = edge_counts(subdivision.faces)
    inside = ~(counts == 1)
    centre = subdivision.points[edges].mean(dim=1)
    rim = (centre[:, :2].min(dim=1).values < 1e-9) | (centre[:, :2].max(dim=1).values > 1 - 1e-9)
    assert (inside == ~rim).all()
    within = (subdivision.points[:, 1] > coordinate + 1e-9) & (coordinate > 1e-9) & ~on_top
    assert within.sum() == 1  # the coarser facet is fine along that edge alone


def test_every_vertex_is_at_its_barycentric_coordinates():
    vertices, facets = ragged_fan()
    subdivision = subdivide(vertices, facets, all_spacings(facets, 0.05))
    assert_close(subdivision.interpolate(vertices, facets), subdivision.points)
    assert_close(subdivision.barycentric.sum(dim=1), torch.ones(len(subdivision.points)).double())
    assert (subdivision.barycentric >= 0).all()
    for corner in range(3):  # corners of a face are in the closed triangle of its facet
        points = subdivision.points[subdivision.faces[:, corner]]
        a, b, c = vertices[facets[subdivision.face_facet]].unbind(dim=1)
        normal = torch.linalg.cross(b - a, c - a)
        assert ((points - a) * normal).sum(-1).abs().max() < 1e-12
        for start, end in ((a, b), (b, c), (c, a)):
            side = (torch.linalg.cross(end - start, points - start) * normal).sum(-1)
            assert side.min() > -1e-12


def test_unused_vertices_of_the_coarse_mesh_are_dropped():
    vertices, facets = icosphere(0)
    more = torch.cat([torch.full((2, 3), 9.0, dtype=torch.float64), vertices])
    subdivision = subdivide(more, facets + 2, all_spacings(facets, 0.3))
    assert subdivision.points.abs().max() <= 1
    assert isinstance(subdivision, Subdivision)


def test_smooth_values_are_transferred_from_a_coarser_subdivision():
    fine, rough = map(subdivided_square, (0.02, 0.04))

    def wave(subdivision):
        return 1 + torch.sin(3 * subdivision.points[:, 0]) * subdivision.points[:, 1]

    off = transferred(wave(rough), rough, fine.points) - wave(fine)
    assert off.abs().max() < 3.2 * 0.04 / 2  # the slope, over half a spacing
    assert off.abs().mean() < 0.005
    assert_close(transferred(wave(rough), rough, rough.points), wave(rough))
