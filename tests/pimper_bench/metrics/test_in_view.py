import pytest
import torch

from pimper_bench.metrics import (
    compare_albedo,
    compare_along_rays,
)
from pimper_bench.scenes.procedural_meshes import join
from pimper_bench.truth import Truth
from pimper_torch.geometry.visibility import cast_view


def with_maps(make, truth, cameras):
    """Return a capture with maps rendered from a mesh."""
    hits = [cast_view(truth, cameras, view) for view in range(cameras.num_views)]
    return Truth(
        depth=torch.stack([hit.distance for hit in hits]),
        normals_world=torch.stack(
            [hit.interpolate(truth.vertices_world, truth.faces) for hit in hits]
        ),
        albedo=torch.stack(
            [hit.interpolate(truth.vertices_world.abs() + 0.1, truth.faces) for hit in hits]
        ),
    )


def test_the_true_mesh_has_no_error(make):
    sphere, cameras = make.sphere(level=4), make.cameras(count=2)
    mesh = sphere.replace(albedo=3 * (sphere.vertices_world.abs() + 0.1))
    truth = with_maps(make, sphere, cameras)
    found = compare_along_rays(mesh, make.capture(truth, cameras=cameras), 1)
    assert found.name == "view_1.png"
    assert found.relative_error < 1e-4  # the ray caster uses float32
    assert found.coverage == 1.0
    assert found.transferred_normals is None
    assert found.shape_normals.mean_deg < 0.5  # facets
    assert found.albedo.one_scale_percent < 1e-3


def test_transferred_normals_are_distinguished_from_those_of_the_shape(make, generator):
    sphere, cameras = make.sphere(level=4), make.cameras(count=1)
    tilt = make.rotation(generator, 10.0)
    # Normals at the tilt's axis do not change: the mean angle is below 10, the shape's is not.
    mesh = sphere.replace(normals_world=sphere.vertices_world @ tilt.mT)
    truth = with_maps(make, sphere, cameras)
    found = compare_along_rays(mesh, make.capture(truth, cameras=cameras), 0)
    assert found.shape_normals.mean_deg < 0.5
    normals = truth.normals_world[0][truth.depth[0].isfinite()].double()
    cosine = (normals * (normals @ tilt.mT)).sum(dim=1) / normals.square().sum(dim=1)
    expected = torch.rad2deg(cosine.clamp(-1, 1).acos())
    assert found.transferred_normals.mean_deg == pytest.approx(float(expected.mean()), abs=0.02)
    assert found.transferred_normals.median_deg == pytest.approx(float(expected.median()), abs=0.05)


def test_a_true_mesh_replaces_missing_maps(make):
    sphere, cameras = make.sphere(level=4), make.cameras(count=1)
    table = make.square(side=9.0)
    table = table.replace(vertices_world=table.vertices_world - 3.0)
    truth = Truth(mesh=sphere, surroundings=table)
    found = compare_along_rays(sphere, make.capture(truth, cameras=cameras), 0)
    alone = compare_along_rays(sphere, make.capture_of(sphere, cameras=cameras), 0)
    assert found.coverage == 1.0  # the table is ignored
    assert found.pixels == alone.pixels
    assert found.shape_normals.mean_deg < 1e-3


def on_a_table(make):
    """Return a ball on a large table, and cameras above both."""
    ball = make.sphere(level=4)
    table = make.square(height=-1.0, side=20.0)
    table = table.replace(vertices_world=table.vertices_world - torch.tensor([10.0, 10.0, 0.0]))
    return ball, table, make.cameras(count=1)


def half_of(mesh):
    right = mesh.vertices_world[mesh.faces].mean(dim=1)[:, 0] > 0
    return mesh.replace(faces=mesh.faces[right])


def test_rays_through_a_hole_that_hit_the_table_are_misses(make):
    ball, table, cameras = on_a_table(make)
    half = half_of(ball)
    capture = make.capture(Truth(mesh=ball, surroundings=table), cameras=cameras)
    alone = compare_along_rays(half, capture, 0)
    found = compare_along_rays(join(half, table), capture, 0)
    unknown = compare_along_rays(join(half, table), make.capture_of(ball, cameras=cameras), 0)
    assert 0.4 < alone.coverage < 0.8
    assert found.coverage == alone.coverage
    assert found.relative_error == pytest.approx(alone.relative_error, abs=1e-6)
    assert unknown.coverage == 1.0  # if the table is unknown, its error counts for the object
    assert unknown.relative_error > 20


def test_a_surface_behind_the_true_one_is_not_table(make):
    ball, table, cameras = on_a_table(make)
    small = ball.replace(vertices_world=0.9 * ball.vertices_world)
    capture = make.capture(Truth(mesh=ball, surroundings=table), cameras=cameras)
    found = compare_along_rays(join(small, table), capture, 0)
    alone = compare_along_rays(small, capture, 0)
    assert found.coverage == alone.coverage
    raised = table.replace(vertices_world=table.vertices_world + torch.tensor([0.0, 0.0, 0.5]))
    before = compare_along_rays(join(ball, raised), capture, 0)
    assert before.coverage == 1.0  # in front of the object it is an error and not a miss


def test_pixels_without_truth_are_not_compared(make):
    sphere, cameras = make.sphere(level=2), make.cameras(count=1)
    empty = make.capture(Truth(), cameras=cameras)
    assert compare_along_rays(sphere, empty, 0) is None
    cloud = sphere.replace(faces=sphere.faces[:0])
    assert compare_along_rays(cloud, make.capture_of(sphere, cameras=cameras), 0) is None


def test_albedo_is_evaluated_up_to_one_scale_and_one_per_channel():
    truth = torch.tensor([[0.2, 0.4], [0.6, 0.2], [0.4, 0.8]], dtype=torch.float64)
    scaled = compare_albedo(0.1 * truth, truth)
    assert scaled.one_scale_percent < 1e-10
    tinted = compare_albedo(truth * truth.new_tensor([1.0, 2.0]), truth)
    assert tinted.channel_scales_percent < 1e-10
    # s = sum a t / sum a^2 = (.56 + 2 * .84) / (.56 + 4 * .84); the rest by hand.
    s = (0.56 + 2 * 0.84) / (0.56 + 4 * 0.84)
    rest = (s - 1) ** 2 * 0.56 + (2 * s - 1) ** 2 * 0.84
    assert tinted.one_scale_percent == pytest.approx(100 * (rest / 1.4) ** 0.5)


def test_an_outlier_changes_the_mean_of_albedo_and_not_its_median():
    truth = torch.full((101, 1), 0.5, dtype=torch.float64)
    ours = truth.clone()
    ours[0] = 50
    found = compare_albedo(ours, truth)
    assert found.one_scale_percent > 50
    assert found.one_scale_median_percent < 1e-10
    assert found.samples == 101


def test_grey_albedo_is_compared_with_the_mean_of_colours():
    truth = torch.tensor([[0.2, 0.4, 0.6], [0.6, 0.2, 0.1]], dtype=torch.float64)
    found = compare_albedo(2 * truth.mean(dim=1, keepdim=True), truth)
    assert found.channels == 1
    assert found.one_scale_percent < 1e-10
    assert compare_albedo(0 * truth, truth) is None
