import numpy as np
import torch
import trimesh
from surfaces import surface_of
from torch.nn.functional import normalize
from torch.testing import assert_close

from pimper_bench.scenes.procedural_meshes import icosphere
from pimper_torch.geometry.surfaces import vertex_normals
from pimper_torch.geometry.topology import (
    boundary_loops,
    boundary_vertices,
    face_edges,
    vertex_components,
)
from pimper_torch.records import Mesh
from pimper_torch.stages.meshing import repair as repairing
from pimper_torch.stages.meshing.extract import Extract
from pimper_torch.stages.meshing.faults import faults
from pimper_torch.stages.meshing.repair import Repair, minimize_bending, repair, surroundings


def supported(vertices, faces, facet=None):
    """Return a fully supported surface; facets default to octants."""
    if facet is None:
        facet = ((vertices > 0).long() * torch.tensor([1, 2, 4])).sum(dim=1)
    certain = torch.full_like(vertices[:, 0], 1e30)
    return surface_of(vertices, faces, facet=facet, albedo=vertices.abs(), information=certain)


def folded_sphere(subdivisions=4):
    """Return a unit sphere, and one folded in three places."""
    vertices, faces = icosphere(subdivisions)
    dragged = vertices.clone()
    step = 2.5 * float(sides(vertices, faces).median())
    for direction in ([1.0, 0.3, 0.2], [-0.2, 1.0, 0.4], [0.1, -0.5, -1.0]):
        centre = normalize(torch.tensor(direction).double(), dim=0)
        near = (vertices @ centre).topk(3).indices
        along = torch.linalg.cross(centre, centre.new_tensor([0.0, 0.6, 0.8]))
        dragged[near] = 0.95 * vertices[near] + step * normalize(along, dim=0)
    return vertices, supported(dragged, faces, supported(vertices, faces).facet)


def overturned(mesh, facet):
    return faults(mesh.vertices_world, mesh.faces, facet, torch.inf).overturned(mesh.vertices_world)


def sides(vertices, faces):
    edges, _ = face_edges(faces)
    return (vertices[edges[:, 0]] - vertices[edges[:, 1]]).norm(dim=1)


def solid(mesh):
    return trimesh.Trimesh(mesh.vertices_world.numpy(), mesh.faces.numpy(), process=False)


def folds(mesh):
    return (solid(mesh).face_adjacency_angles > np.pi / 2).sum()


def test_a_folded_sphere_stays_closed():
    sphere, surface = folded_sphere()
    slit = Extract()(surface)
    assert int(boundary_loops(slit.faces)[1].max()) + 1 >= 3
    mesh = Extract()(Repair()(surface))
    assert solid(mesh).is_volume
    assert folds(mesh) == 0
    assert solid(mesh).euler_number == 2
    assert torch.equal(mesh.faces, surface.faces)
    assert not overturned(mesh, surface.facet).any()
    true = solid(surface.replace(vertices_world=sphere)).volume
    assert abs(solid(mesh).volume / true - 1) < 3e-5  # plates cut off a little
    assert abs(solid(surface).volume / true - 1) > 3e-4
    # A plate over three rings of the sphere is off by a thousandth; vertices were off by 50.
    assert (mesh.vertices_world.norm(dim=1) - 1).abs().max() < 2e-3


def test_only_repaired_vertices_change_and_their_confidence_is_zero():
    _, surface = folded_sphere()
    mesh = Extract()(Repair()(surface))
    moved = (mesh.vertices_world != surface.vertices_world).any(dim=1)
    assert 9 <= moved.sum() < 0.1 * len(moved)
    assert torch.equal(mesh.confidence == 0, moved)
    assert torch.equal(mesh.albedo, surface.albedo)
    beside = torch.zeros_like(moved)
    beside[surface.faces[moved[surface.faces].any(dim=1)].flatten()] = True
    assert_close(mesh.normals_world[~beside], surface.normals_world[~beside])
    own = vertex_normals(mesh.vertices_world, mesh.faces)
    assert_close(mesh.normals_world[beside], own[beside])


def test_without_repair_exactly_the_flipped_faces_are_removed():
    _, surface = folded_sphere()
    gone = overturned(surface, surface.facet)
    mesh = Extract()(surface)
    assert gone.sum() > 6
    kept = surface.vertices_world[surface.faces[~gone]]
    assert torch.equal(mesh.vertices_world[mesh.faces], kept)
    assert set(mesh.confidence.tolist()) == {1.0}


def test_restricting_the_search_to_folds_does_not_change_the_result():
    _, surface = folded_sphere(5)
    vertices = surface.vertices_world
    found = faults(vertices, surface.faces, surface.facet, 10.0)
    farthest = torch.tensor(0.1 * 2 * 3**0.5).double()
    whole, moved = repair(vertices, surface.faces, found.broken, farthest)
    assert moved.any()
    near = surroundings(surface.faces, found.broken(vertices), len(vertices))
    assert near.sum() < 0.7 * len(near)
    assert_close(Repair()(surface).vertices_world, whole)


def test_a_real_opening_is_kept():
    _, surface = folded_sphere()
    below = (surface.vertices_world[:, 2] > -0.3) & (surface.vertices_world[:, 0] > -0.9)
    bowl = surface.replace(faces=surface.faces[below[surface.faces].all(dim=1)])
    repaired = Repair()(bowl)
    mesh = Mesh(vertices_world=repaired.vertices_world, faces=repaired.faces)
    contours = [
        {tuple(row) for row in points[boundary_loops(faces)[0]].flatten(1).tolist()}
        for points, faces in ((mesh.vertices_world, mesh.faces), (bowl.vertices_world, bowl.faces))
    ]
    assert len(contours[0]) > 20
    assert contours[0] == contours[1]
    assert folds(mesh) == 0


def test_a_fold_at_the_border_is_removed():
    _, surface = folded_sphere()
    fold = faults(surface.vertices_world, surface.faces, surface.facet, torch.inf).broken(
        surface.vertices_world
    )
    through = torch.zeros_like(surface.facet, dtype=torch.bool)
    group = vertex_components(surface.faces[fold], torch.ones_like(through))
    dragged = (surface.vertices_world.norm(dim=1) - 1).abs() > 1e-3
    for label in torch.unique(group[dragged]).tolist():
        through[((group == label) & dragged).nonzero()[0]] = True
    cut = surface.replace(faces=surface.faces[~through[surface.faces].any(dim=1)])
    folds = faults(cut.vertices_world, cut.faces, cut.facet, torch.inf)
    gone = folds.folded_over(cut.vertices_world)
    assert gone.sum() > 6
    mesh = Extract()(Repair()(cut))
    assert (mesh.confidence == 1).all()
    assert_close(mesh.vertices_world[mesh.faces], cut.vertices_world[cut.faces[~gone]])


def test_a_fold_that_extends_too_far_is_not_repaired(monkeypatch):
    monkeypatch.setattr(repairing, "_MAX_EXTENT", 0.01)
    _, surface = folded_sphere()
    left = Repair()(surface)
    assert torch.equal(left.vertices_world, surface.vertices_world)
    assert torch.equal(left.confidence, surface.confidence)


def test_a_spike_is_flattened():
    vertices, faces = icosphere(4)
    spiked = vertices.clone()
    spiked[100] *= 3
    mesh = Extract()(Repair()(supported(spiked, faces)))
    assert solid(mesh).is_volume
    assert_close(mesh.vertices_world[100].norm(), torch.ones(()).double(), rtol=0, atol=0.01)
    assert not solid(Extract()(supported(spiked, faces))).is_watertight


def test_a_facet_that_bends_far_has_no_fold():
    """A sphere that is a single facet: half of it is averted from any mean normal."""
    vertices, faces = icosphere(3)
    bulge = vertices.clone()
    bulge[:, 2] = torch.where(bulge[:, 2] > 0, 4 * bulge[:, 2], bulge[:, 2])
    surface = supported(bulge, faces, torch.zeros(len(bulge), dtype=torch.long))
    surface = surface.replace(faces=faces[(bulge[faces][..., 2] > -0.8).all(dim=1)])
    assert overturned(surface, surface.facet).any()
    mesh = Extract()(Repair()(surface))
    assert len(mesh.faces) == len(surface.faces)
    assert (mesh.confidence == 1).all()


def test_gradients_reach_fixed_vertices_and_no_repaired_ones():
    _, surface = folded_sphere(3)
    leaf = surface.vertices_world.clone().requires_grad_()
    mesh = Extract()(Repair()(surface.replace(vertices_world=leaf)))
    moved = (mesh.vertices_world != surface.vertices_world).any(dim=1)
    (gradient,) = torch.autograd.grad(mesh.vertices_world[moved].sum(), leaf)
    assert (gradient[moved] == 0).all()
    # A shift of all fixed vertices shifts the repaired ones.
    assert_close(gradient.sum(dim=0), moved.sum().double().expand(3))
    clone = surface.vertices_world[:42].clone().requires_grad_()
    _, coarse = icosphere(1)
    free = torch.zeros(42, dtype=torch.bool)
    free[[0, 5]] = True
    assert torch.autograd.gradcheck(lambda places: minimize_bending(places, coarse, free), clone)


def test_positions_of_least_bending_equal_a_dense_solve(generator):
    vertices, faces = icosphere(2)
    vertices = vertices + 0.1 * torch.randn(vertices.shape, generator=generator).double()
    free = torch.rand(len(vertices), generator=generator) < 0.3
    edges, _ = face_edges(faces)
    near = torch.zeros(len(vertices), len(vertices)).double()
    near[edges[:, 0], edges[:, 1]] = near[edges[:, 1], edges[:, 0]] = 1
    bending = torch.eye(len(vertices)).double() - near / near.sum(dim=1, keepdim=True)
    bending[~free & ~(near[:, free] > 0).any(dim=1)] = 0
    target = -bending[:, ~free] @ vertices[~free]
    best = np.linalg.lstsq(bending[:, free].numpy(), target.numpy(), rcond=None)[0]
    placed = minimize_bending(vertices, faces, free)
    assert_close(placed[free], torch.from_numpy(best))
    assert torch.equal(placed[~free], vertices[~free])


def test_irreparable_defects_are_not_moved():
    vertices, faces = icosphere(3)

    def never(places):
        return torch.arange(len(faces)) == 7

    places, moved = repair(vertices, faces, never, torch.tensor(10.0).double())
    assert torch.equal(places, vertices)
    assert not moved.any()


def test_a_component_without_sound_vertices_is_not_moved():
    vertices, faces = icosphere(1)
    both = torch.cat([vertices, vertices + 5])
    faces = torch.cat([faces, faces + len(vertices)])

    def one_piece(places):
        return (torch.arange(len(faces)) < len(faces) // 2) & (places[0, 0] == both[0, 0])

    places, moved = repair(both, faces, one_piece, torch.tensor(10.0).double())
    assert torch.equal(places, both)
    assert not moved.any()


def test_the_border_is_never_moved():
    _, surface = folded_sphere(3)
    upper = surface.faces[(surface.vertices_world[surface.faces][..., 2] > -0.2).all(dim=1)]
    contour = boundary_vertices(upper, len(surface.vertices_world))

    def growing(places):  # accepts only large moves
        marked = torch.zeros(len(upper), dtype=torch.bool)
        marked[upper.eq(int(upper[0, 0])).any(dim=1).nonzero()[0]] = True
        return marked & ((places != surface.vertices_world).any(dim=1).sum() < 60)

    places, moved = repair(surface.vertices_world, upper, growing, torch.tensor(10.0).double())
    assert moved.sum() >= 60
    assert torch.equal(places[contour], surface.vertices_world[contour])


def test_a_closed_component_does_not_shrink_to_its_only_sound_vertex():
    """All but one vertex of a small sphere next to a large one are on defective faces."""
    vertices, faces = icosphere(2)
    count = len(vertices)
    vertices = torch.cat([5 * vertices, vertices + 9])
    faces = torch.cat([faces, faces + count])
    defective = (faces >= count).all(dim=1) & (faces != count).all(dim=1)

    def broken(moved):
        return defective & (moved[faces] == vertices[faces]).flatten(1).all(dim=1)

    after, moved = repair(vertices, faces, broken, torch.tensor(torch.inf))
    assert not moved.any()
    assert torch.equal(after, vertices)
