import torch
from scenes import ball
from torch.testing import assert_close

from pimper_bench.scenes.procedural_meshes import icosphere, table
from pimper_bench.scenes.render_in_memory import Sphere
from pimper_bench.scenes.scene_cameras import arc_cameras
from pimper_torch.geometry.visibility import RayCaster, cast_view


def brute_force(origin, directions, vertices, faces):
    """Intersect all pairs of rays and faces by Möller-Trumbore."""
    a, b, c = vertices[faces].unbind(dim=1)
    ab, ac = b - a, c - a
    across = torch.linalg.cross(directions[:, None], ac[None].expand(len(directions), -1, -1))
    determinant = (across * ab).sum(-1)
    offset = origin - a
    v = (across * offset).sum(-1) / determinant
    q = torch.linalg.cross(offset, ab)
    w = (directions[:, None] * q).sum(-1) / determinant
    t = (q * ac).sum(-1) / determinant
    ok = (v >= 0) & (w >= 0) & (v + w <= 1) & (t > 0)
    distance, face = torch.where(ok, t, torch.inf).min(dim=1)
    return distance, torch.where(distance.isfinite(), face, -1)


def test_first_hits_agree_with_brute_force(generator):
    vertices, faces = icosphere(2)
    vertices = vertices * (1 + 0.3 * torch.rand(len(vertices), 1, generator=generator).double())
    origin = torch.tensor([0.3, -0.2, 4.0], dtype=torch.float64)
    directions = 0.35 * torch.randn(300, 3, generator=generator, dtype=torch.float64)
    directions[:, 2] = -1.7
    hits = RayCaster(vertices, faces).cast(origin, directions)
    distance, face = brute_force(origin, directions, vertices, faces)
    assert 0.3 < (face >= 0).float().mean() < 0.95
    assert_close(hits.distance, distance, atol=1e-5, rtol=1e-5)  # embree is float32
    assert (hits.face == face).float().mean() > 0.99  # a ray may hit an edge of two
    rebuilt = hits.interpolate(vertices, faces)
    hit = hits.face >= 0
    points = origin + distance[:, None] * directions
    assert_close(rebuilt[hit], points[hit], atol=1e-5, rtol=0)
    assert (rebuilt[~hit] == 0).all()


def test_points_behind_the_ball_are_hidden_and_the_surface_does_not_hide_itself():
    vertices, faces = icosphere(5)
    caster = RayCaster(vertices, faces)
    center = torch.tensor([0.0, 0.0, 5.0], dtype=torch.float64)
    points = torch.tensor([[0.0, 0, 1], [0, 0, -1], [0, 0, -2], [2, 0, 0]], dtype=torch.float64)
    assert caster.occluded(points, center, 0.01).tolist() == [False, True, True, False]
    per_point = torch.tensor([0.01, 3.0, 3.5, 0.01], dtype=torch.float64)
    assert caster.occluded(points, center, per_point).tolist() == [False] * 4


def test_depth_of_a_ball_is_along_the_camera_axis():
    cameras = arc_cameras(2, width=24, height=18, focal_px=40.0, distance=4.0)
    mesh = ball(level=5)
    hits = cast_view(mesh, cameras, 1)
    assert hits.distance.shape == (18, 24)
    points_world = hits.interpolate(mesh.vertices_world, mesh.faces)
    points_cam = points_world @ cameras.cam_from_world[1, :3, :3].mT
    depth = points_cam[..., 2] + cameras.cam_from_world[1, 2, 3]
    hit = hits.face >= 0
    assert 0.2 < hit.float().mean() < 0.9
    assert_close(hits.distance[hit], depth[hit], atol=1e-5, rtol=0)
    # The ray through the image centre passes through the centre of the ball.
    around = hits.distance[8:10, 11:13]
    assert_close(around, torch.full_like(around, 3.0), atol=2e-3, rtol=0)
    origin = cameras.centers_world[1].expand(1, 3)
    closed = Sphere().intersect(origin, -origin / 4)
    assert_close(closed, torch.tensor([3.0]).double())


def test_dtype_and_shape_follow_the_rays():
    caster = RayCaster(table(1.0).vertices_world, table(1.0).faces)
    directions = torch.zeros(2, 5, 3)
    directions[..., 2] = -1
    hits = caster.cast(torch.tensor([0.3, 0.1, 1.0]), directions)
    assert hits.distance.dtype == torch.float32
    assert hits.face.shape == (2, 5)
    assert hits.barycentric.shape == (2, 5, 3)
    one = caster.cast(torch.tensor([0.3, 0.1, 1.0]), directions[0, 0])
    assert one.face.shape == ()


def test_a_ray_is_blocked_if_its_first_hit_is_within_reach(generator):
    vertices, faces = icosphere(2)
    caster = RayCaster(vertices, faces)
    origins = 0.7 * torch.randn(500, 3, generator=generator, dtype=torch.float64)
    directions = torch.randn(500, 3, generator=generator, dtype=torch.float64)
    reach = 3 * torch.rand(500, generator=generator, dtype=torch.float64)
    reach[::7] = torch.inf
    first = caster.cast(origins, directions).distance
    found = caster.blocked(origins, directions, reach)
    assert 0.1 < found.float().mean() < 0.9
    assert (found == (first < reach))[(first - reach).abs() > 1e-5].all()


def test_hits_of_a_mesh_do_not_depend_on_its_distance_to_the_origin(generator):
    vertices, faces = icosphere(3)
    directions = torch.randn(500, 3, generator=generator, dtype=torch.float64)
    starts = 3 * torch.randn(500, 3, generator=generator, dtype=torch.float64)
    directions = 0.4 * directions - starts
    near = RayCaster(vertices, faces)
    shift = torch.tensor([448231.0, 5411923.0, 312.0], dtype=torch.float64)
    far = RayCaster(vertices + shift, faces)
    one, other = near.cast(starts, directions), far.cast(starts + shift, directions)
    assert float((one.face == other.face).double().mean()) > 0.99  # except rays along edges
    assert_close(one.distance, other.distance, rtol=0, atol=1e-5)
    outside = starts.norm(dim=1) > 1.1
    args = directions, torch.full((500,), torch.inf, dtype=torch.float64)
    assert torch.equal(
        near.blocked(starts, *args)[outside], far.blocked(starts + shift, *args)[outside]
    )
    center = torch.tensor([0.0, 0, 5], dtype=torch.float64)
    assert torch.equal(
        near.occluded(vertices, center, 1e-3), far.occluded(vertices + shift, center + shift, 1e-3)
    )
