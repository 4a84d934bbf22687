import pytest
import torch
from torch.testing import assert_close

from pimper_torch.geometry.projection import project
from pimper_torch.geometry.rigid import transform
from pimper_torch.runtime.errors import ReconstructionError
from pimper_torch.stages.patches.decompose import Decompose, enlarge, group_by_size, views_facing
from pimper_torch.stages.patches.patches_config import DecomposeConfig
from tests.patches.test_transfer import places


def test_the_facet_is_in_the_plane_z_0_and_faces_the_camera(plane_scene, plane_mesh):
    patches = Decompose()(plane_mesh, plane_scene.cameras)
    vertices, faces = plane_mesh.mesh.vertices_world, plane_mesh.mesh.faces
    for bucket in patches.buckets:
        corners = transform(bucket.patch_from_world, vertices[faces[bucket.facet]])
        assert corners[..., 2].abs().max() < 1e-12
        rotation = bucket.patch_from_world[:, :3, :3]
        assert_close(rotation @ rotation.mT, torch.eye(3).expand_as(rotation).double())
        assert_close(torch.linalg.det(rotation), torch.ones(len(rotation)).double())
        center = plane_scene.cameras.centers_world[plane_mesh.reference]
        in_patch = transform(bucket.patch_from_world, center.expand(len(rotation), 1, 3))
        assert (in_patch[..., 2] < 0).all()  # z points into the surface


def test_barycentric_coordinates_reproduce_every_sample(plane_scene, plane_mesh):
    patches = Decompose()(plane_mesh, plane_scene.cameras)
    vertices, faces = plane_mesh.mesh.vertices_world, plane_mesh.mesh.faces
    for bucket in patches.buckets:
        corners = vertices[faces[bucket.facet]]
        blended = torch.einsum("phwc,pcx->phwx", bucket.barycentric, corners)
        points = bucket.points_patch
        in_patch = transform(bucket.patch_from_world, blended.flatten(1, 2))
        assert_close(in_patch, points.flatten(1, 2), atol=1e-9, rtol=0)


def test_every_point_near_a_facet_has_a_sample_and_samples_are_a_pixel_apart(
    plane_scene, plane_mesh
):
    config = DecomposeConfig(overlap_samples=5.0)
    patches = Decompose(config)(plane_mesh, plane_scene.cameras)
    for bucket in patches.buckets:
        spacing = bucket.spacing[:, None, None]
        area = bucket.inside.sum(dim=(1, 2)) * bucket.spacing**2
        corners = transform(
            bucket.patch_from_world,
            plane_mesh.mesh.vertices_world[plane_mesh.mesh.faces[bucket.facet]],
        )[..., :2]
        enlarged = enlarge(corners, 5.0 * bucket.spacing[0])
        ab, ac = enlarged[:, 1] - enlarged[:, 0], enlarged[:, 2] - enlarged[:, 0]
        wanted = (ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]).abs() / 2
        # Discrete samples along the contour, and corners clipped at twice the overlap: 3 %.
        assert ((area - wanted).abs() / wanted < 0.03).all()
        reference = plane_mesh.reference
        camera = plane_scene.cameras.cam_from_world[reference]
        K = plane_scene.cameras.intrinsics[reference]
        pixels, _ = project(places(bucket).reshape(-1, 3), camera, K)
        steps = pixels.reshape(*spacing.shape[:1], *bucket.depth.shape[1:], 2).diff(dim=2)
        assert 0.8 < steps.norm(dim=-1).median() < 1.2


def test_enlarged_edges_are_parallel_and_moved_by_the_distance():
    generator = torch.Generator().manual_seed(0)
    corners = torch.randn(20, 3, 2, generator=generator, dtype=torch.float64)
    moved = enlarge(corners, torch.tensor(0.3, dtype=torch.float64))
    old = corners.roll(-1, dims=1) - corners
    new = moved.roll(-1, dims=1) - moved
    cross = old[..., 0] * new[..., 1] - old[..., 1] * new[..., 0]
    assert cross.abs().max() < 1e-9
    normal = torch.stack([old[..., 1], -old[..., 0]], dim=-1) / old.norm(dim=-1, keepdim=True)
    shift = ((moved - corners) * normal).sum(dim=-1)
    inward = ((corners.mean(dim=1, keepdim=True) - corners) * normal).sum(dim=-1).sign()
    assert_close(-inward * shift, torch.full((20, 3), 0.3, dtype=torch.float64))


def test_buckets_contain_every_facet_once_and_fit_their_rasters():
    generator = torch.Generator().manual_seed(1)
    sides = torch.randint(5, 90, (300, 2), generator=generator)
    buckets = group_by_size(sides, bucket_samples=20_000)
    listed = torch.cat([facets for facets, _ in buckets])
    assert sorted(listed.tolist()) == list(range(300))
    for facets, (height, width) in buckets:
        assert (sides[facets, 0] <= width).all()
        assert (sides[facets, 1] <= height).all()
        assert len(facets) * height * width <= 20_000
    padded = sum(len(facets) * height * width for facets, (height, width) in buckets)
    assert padded < 1.6 * sides.prod(dim=1).sum()


def test_a_mesh_without_facets_is_rejected(plane_scene, plane_mesh):
    empty = plane_mesh.replace(
        mesh=plane_mesh.mesh.replace(faces=torch.zeros(0, 3, dtype=torch.long))
    )
    with pytest.raises(ReconstructionError, match="0 facets"):
        Decompose()(empty, plane_scene.cameras)


@pytest.mark.parametrize("scale", [0.5, 2.0])
def test_sample_spacing_follows_the_scale_of_the_photographs(plane_scene, plane_mesh, scale):
    one = Decompose()(plane_mesh, plane_scene.cameras).buckets[0].spacing[0]
    scaled = Decompose()(plane_mesh, plane_scene.cameras, None, scale).buckets[0].spacing[0]
    assert_close(scaled, one / scale)


def test_the_number_of_samples_is_limited(plane_scene, plane_mesh):
    def on_facets(**settings: float) -> int:
        patches = Decompose(DecomposeConfig(**settings))(plane_mesh, plane_scene.cameras)
        return sum(int((b.barycentric >= 0).all(dim=-1).sum()) for b in patches.buckets)

    views = plane_scene.cameras.num_views
    assert views > 1
    free, bound = on_facets(), on_facets(max_samples=1000.0 * views)
    assert free > 3000
    assert abs(bound / 1000 - 1) < 0.05
    assert on_facets(max_samples=2.0 * free * views) == free


def test_averted_views_do_not_affect_the_sample_spacing(plane_scene, plane_mesh):
    away = plane_mesh.mesh.faces.flip(1)
    views = plane_scene.cameras.num_views
    there = plane_mesh.mesh.vertices_world
    both = torch.cat([plane_mesh.mesh.faces, away])
    assert views_facing(there, both, plane_scene.cameras).tolist() == [views, views, 0, 0]
    aside = there + there.new_tensor([50.0, 0.0, 0.0])  # outside all frames
    assert views_facing(aside, plane_mesh.mesh.faces, plane_scene.cameras).tolist() == [0, 0]

    def spacing(faces: torch.Tensor) -> torch.Tensor:
        mesh = plane_mesh.mesh.replace(faces=faces)
        bound = Decompose(DecomposeConfig(max_samples=1000.0 * views))
        return bound(plane_mesh.replace(mesh=mesh), plane_scene.cameras).buckets[0].spacing[0]

    assert_close(spacing(both), spacing(plane_mesh.mesh.faces))
