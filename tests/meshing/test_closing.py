import pytest
import torch
import trimesh
from torch.testing import assert_close

from pimper_bench.scenes.procedural_meshes import icosphere
from pimper_torch.geometry.topology import face_components, face_edges
from pimper_torch.records import ClosedMesh, Mesh
from pimper_torch.runtime.errors import InputError
from pimper_torch.stages.meshing.closing import border_cycles, capped, closed


def ball(*, above: float, level: int = 4) -> Mesh:
    """Return a ball without its parts above a height and below the negative height."""
    vertices, faces = icosphere(level)
    vertices = vertices.double()
    left = (vertices[faces].mean(dim=1)[:, 2].abs() < above).nonzero()[:, 0]
    used, faces = torch.unique(faces[left], return_inverse=True)
    vertices = vertices[used]
    return Mesh(
        vertices_world=vertices,
        faces=faces,
        normals_world=vertices,
        albedo=torch.full((len(vertices), 3), 0.4).double(),
        confidence=torch.ones(len(vertices)).double(),
        expected_error=torch.full((len(vertices),), 0.01).double(),
    )


def solid(mesh: Mesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices_world.numpy(), mesh.faces.numpy(), process=False)


def test_a_ball_without_poles_is_closed_by_two_flat_caps():
    mesh = ball(above=0.7)
    found = closed(mesh)
    whole = solid(found.mesh)
    assert whole.is_watertight
    assert whole.is_winding_consistent
    assert found.borders == 2
    # A slice of a ball between planes at ±h has volume 2 pi (h - h^3 / 3); borders are ragged.
    assert whole.volume == pytest.approx(2 * torch.pi * (0.7 - 0.7**3 / 3), rel=0.03)
    heights = found.mesh.vertices_world[found.mesh.faces[~found.measured]][..., 2].abs()
    assert_close(heights, torch.full_like(heights, 0.7), atol=0.07, rtol=0)
    assert bool(((found.mesh.normals_world[len(mesh.vertices_world) :, 2]).abs() > 0.9).all())


def test_measured_surface_is_kept_and_caps_are_marked():
    mesh = ball(above=0.7)
    found = closed(mesh)
    count = len(mesh.vertices_world)
    assert torch.equal(found.mesh.faces[found.measured], mesh.faces)
    for name in ("vertices_world", "normals_world", "albedo", "confidence", "expected_error"):
        assert torch.equal(getattr(found.mesh, name)[:count], getattr(mesh, name)), name
    assert bool((found.mesh.confidence[count:] == 0).all())
    extent = (mesh.vertices_world.amax(dim=0) - mesh.vertices_world.amin(dim=0)).norm()
    errors = found.mesh.expected_error[count:]
    assert_close(errors, extent.expand_as(errors))
    assert_close(found.mesh.albedo[count:], torch.full_like(found.mesh.albedo[count:], 0.4))


def test_a_border_without_albedo_is_closed():
    mesh = ball(above=0.7)
    unknown = torch.tensor(border_cycles(mesh.faces)[0][:5])
    albedo = mesh.albedo.clone()
    albedo[unknown] = torch.nan
    found = closed(mesh.replace(albedo=albedo)).mesh
    count = len(mesh.vertices_world)
    assert torch.equal(found.albedo[:count].isnan(), albedo.isnan())
    assert_close(found.albedo[count:], torch.full_like(found.albedo[count:], 0.4))
    assert torch.equal(found.vertices_world, closed(mesh).mesh.vertices_world)


def test_a_closed_mesh_is_unchanged():
    vertices, faces = icosphere(2)
    found = closed(Mesh(vertices_world=vertices, faces=faces))
    assert found.borders == 0
    assert torch.equal(found.mesh.vertices_world, vertices)
    assert torch.equal(found.mesh.faces, faces)


def test_touching_holes_and_separate_components_are_closed():
    vertices, faces = icosphere(2)
    fan = (faces == 20).any(dim=1).nonzero()[:, 0].tolist()
    others = {index: {*faces[index].tolist()} - {20} for index in fan}
    opposite = next(index for index in fan if not others[index] & others[fan[0]])
    keep = torch.ones(len(faces), dtype=torch.bool)
    keep[[fan[0], opposite]] = False
    two = torch.cat([faces[keep], faces[keep] + len(vertices)])
    both = torch.cat([vertices, vertices + 5])
    found = closed(Mesh(vertices_world=both, faces=two))
    assert solid(found.mesh).is_watertight
    assert len(face_components(found.mesh.faces).unique()) == 2
    assert found.borders == 2  # touching holes count as one


def test_a_moebius_strip_is_rejected():
    count = 12
    turn = torch.arange(count)
    upper, lower = turn, turn + count
    following, below = (turn + 1) % count, (turn + 1) % count + count
    following[-1], below[-1] = count, 0
    halves = (upper, lower, following), (following, lower, below)
    faces = torch.cat([torch.stack(half, dim=1) for half in halves])
    with pytest.raises(InputError, match="opposite orientation"):
        closed(Mesh(vertices_world=torch.rand(2 * count, 3), faces=faces))


def test_caps_propagate_gradients_to_their_border():
    mesh = ball(above=0.5, level=2)
    vertices = mesh.vertices_world.clone().requires_grad_()
    found = closed(mesh.replace(vertices_world=vertices))
    # Caps move with their border.
    found.mesh.vertices_world[len(vertices) :].sum().backward()
    borders = torch.cat([torch.tensor(cycle) for cycle in border_cycles(mesh.faces)])
    assert set(vertices.grad.abs().sum(dim=1).nonzero()[:, 0].tolist()) == set(borders.tolist())
    fresh = len(found.mesh.vertices_world) - len(vertices)
    assert_close(vertices.grad.sum(dim=0), torch.full((3,), float(fresh)).double())


def intersections(found: ClosedMesh) -> int:
    """Count edges through faces without a common vertex, one of them of a cap, by brute force."""
    vertices, caps = found.mesh.vertices_world.double(), found.mesh.faces[~found.measured]
    surface = found.mesh.faces[found.measured]
    return sum(passing(vertices, *pair) for pair in ((caps, found.mesh.faces), (surface, caps)))


def passing(vertices, first, second) -> int:
    edges, _ = face_edges(first)
    origin, one, two = (vertices[second[:, corner]] for corner in range(3))
    one, two = one - origin, two - origin
    count = 0
    for chunk in edges.split(200):  # Moeller and Trumbore, 1997
        start = vertices[chunk[:, 0]]
        along = (vertices[chunk[:, 1]] - start)[:, None].expand(-1, len(second), -1)
        offset, across = start[:, None] - origin, torch.linalg.cross(along, two[None])
        turned, scale = torch.linalg.cross(offset, one[None]), (one * across).sum(dim=-1)
        products = ((offset * across), (along * turned), (two * turned))
        u, v, t = (product.sum(dim=-1) / scale for product in products)
        through = (u > 0) & (v > 0) & (u + v < 1) & (t > 0) & (t < 1)
        apart = (second[None, :, :, None] != chunk[:, None, None, :]).flatten(2).all(dim=2)
        count += int((through & apart).sum())
    return count


def bowl(*, cone: float) -> Mesh:
    """Return a half ball, open above, with a cone from its bottom to a height above the rim."""
    whole = ball(above=2.0).replace(normals_world=None)
    lower = (whole.vertices_world[whole.faces][..., 2] < 0.05).all(dim=1)
    used, faces = torch.unique(whole.faces[lower], return_inverse=True)
    x, y, z = whole.vertices_world[used].unbind(dim=1)
    raised = z + (1 + cone) * (1 - torch.hypot(x, y) / 0.4).clamp_min(0)
    vertices = torch.stack([x, y, raised], dim=1)
    return whole.take(used).replace(faces=faces, vertices_world=vertices)


def test_a_cap_does_not_cut_through_the_surface():
    low, high = bowl(cone=-0.3), bowl(cone=0.5)
    assert intersections(capped(low)) == 0
    assert len(closed(low).mesh.faces) == len(capped(low).mesh.faces)
    assert intersections(capped(high)) > 10
    found = closed(high)
    assert intersections(found) == 0
    assert solid(found.mesh).is_volume
    # Only the cone above the rim is trimmed, and its stump is capped.
    left = found.mesh.faces[found.measured]
    assert found.borders == 2
    assert 0.9 * len(high.faces) < len(left) < len(high.faces)
    heights = found.mesh.vertices_world[left][..., 2]
    assert float(heights.max()) < 0.1
    assert bool((found.mesh.expected_error[len(torch.unique(left)) :] > 1).all())


def test_a_surface_of_which_much_would_be_trimmed_is_capped_as_it_is():
    many = bowl(cone=0.5)
    shifts = torch.tensor([[0.0, 0, 0], [0.3, 0, 0.1], [0.0, 0.3, -0.1], [0.2, 0.2, 0.05]]).double()
    vertices = torch.cat([many.vertices_world + shift for shift in shifts])
    faces = torch.cat([many.faces + index * len(many.vertices_world) for index in range(4)])
    crossing = Mesh(vertices_world=vertices, faces=faces)
    assert len(closed(crossing).mesh.faces) == len(capped(crossing).mesh.faces)
