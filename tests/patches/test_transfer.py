import pytest
import torch
from torch.nn.functional import normalize
from torch.testing import assert_close

from pimper_bench.scenes.procedural_meshes import table
from pimper_torch.geometry.rigid import invert_rigid, rotate, transform
from pimper_torch.geometry.template_normals import coarse_normals, transferred_normals
from pimper_torch.records import CoarseMesh, Mesh
from pimper_torch.stages.patches.decompose import Decompose
from pimper_torch.stages.patches.patches_config import DecomposeConfig
from pimper_torch.stages.patches.transfer import transfer
from pimper_torch.stages.patches.warp import Warp


def bump(xy: torch.Tensor) -> torch.Tensor:
    return 0.1 * (1 - xy.square().sum(dim=-1))


def surface(size: int = 100) -> Mesh:
    """A low dome over the square of the facets, facing +z."""
    flat = table(2.0, cells=size - 1)
    xy = flat.vertices_world[:, :2]
    return Mesh(vertices_world=torch.cat([xy, bump(xy)[:, None]], dim=1), faces=flat.faces)


@pytest.fixture
def flat(plane_scene):
    corners = torch.tensor([[-0.8, -0.7, 0], [0.8, -0.7, 0], [0.8, 0.7, 0], [-0.8, 0.7, 0]])
    mesh = Mesh(vertices_world=corners.double(), faces=torch.tensor([[0, 1, 2], [0, 2, 3]]))
    coarse = CoarseMesh(mesh=mesh, reference=2, is_point=torch.ones(4, dtype=torch.bool))
    return Decompose(DecomposeConfig(samples_per_pixel=0.4))(coarse, plane_scene.cameras)


def places(templates):
    flat = templates.points_patch.flatten(1, 2)
    return transform(invert_rigid(templates.patch_from_world), flat).view_as(templates.points_patch)


def test_samples_are_on_the_surface_above_their_facet_positions(flat):
    transferred = transfer(flat, surface())
    for before, after in zip(flat.buckets, transferred.buckets, strict=True):
        assert torch.equal(before.inside, after.inside)
        there, here = places(after)[after.inside], places(before)[before.inside]
        assert_close(there[:, :2], here[:, :2])
        # Faces are chords: at most a sixth of a thousandth below the dome.
        assert_close(there[:, 2], bump(there[:, :2]), rtol=0, atol=2e-4)
        assert after.depth.abs().max() > 0.05


def test_normals_of_the_surface_are_transferred(flat):
    transferred = transfer(flat, surface())
    for templates in transferred.buckets:
        world = rotate(
            invert_rigid(templates.patch_from_world), templates.normals_patch.flatten(1, 2)
        )
        here = places(templates).reshape(len(world), -1, 3)
        true = normalize(
            torch.cat([0.2 * here[..., :2], torch.ones_like(here[..., :1])], -1), dim=-1
        )
        inside = templates.inside.flatten(1)
        assert_close(world[inside], true[inside], rtol=0, atol=5e-3)
        assert_close(transferred_normals(transferred.coarse, templates), templates.normals_patch)
    flat_ones = transferred_normals(flat.coarse, flat.buckets[0])
    assert_close(flat_ones, coarse_normals(flat.coarse, flat.buckets[0]))


def test_samples_without_surface_are_invalid(flat):
    whole = surface()
    left = whole.vertices_world[whole.faces][..., 0].amax(dim=1) < 0
    transferred = transfer(flat, whole.replace(faces=whole.faces[left]))
    for templates in transferred.buckets:
        x = places(templates)[..., 0]
        assert not templates.inside[x > 0.05].any()
    assert any(bucket.inside.any() for bucket in transferred.buckets)


def test_a_surface_seen_from_behind_is_not_transferred(flat):
    whole = surface()
    rotated = transfer(flat, whole.replace(faces=whole.faces.flip(1)))
    assert not any(bucket.inside.any() for bucket in rotated.buckets)


def test_the_nearest_of_two_sheets_is_transferred(flat):
    near, far = surface(), surface()
    lifted = far.vertices_world + far.vertices_world.new_tensor([0, 0, 0.4])
    both = Mesh(
        vertices_world=torch.cat([near.vertices_world, lifted]),
        faces=torch.cat([near.faces, far.faces + len(near.vertices_world)]),
    )
    for one, other in zip(transfer(flat, near).buckets, transfer(flat, both).buckets, strict=True):
        assert_close(one.depth[one.inside], other.depth[one.inside])


def test_views_are_warped_onto_the_transferred_surface(plane_scene, flat):
    """On the true plane, views show the albedo of each sample; on the facets they do not."""
    normal = torch.tensor([0.2, -0.1, 1.0], dtype=torch.float64)
    whole = surface()
    xy = whole.vertices_world[:, :2]
    plane = whole.replace(vertices_world=torch.cat([xy, -(xy @ normal[:2, None])], dim=1))
    transferred = transfer(flat, plane)

    def spread(patches):
        """Return the largest difference between views; each bucket has common samples."""
        seen = Warp()(plane_scene.views, plane_scene.cameras, patches).buckets
        apart = [one.gray.amax(dim=1) - one.gray.amin(dim=1) for one in seen]
        pairs = zip(apart, seen, strict=True)
        return torch.stack([off[one.valid.all(dim=1)].max() for off, one in pairs]).max()

    assert spread(transferred) < 2e-3
    assert spread(flat) > 0.006
