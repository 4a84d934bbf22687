import torch
from one_view import photograph, point_lights
from reliefs import ball, bumps, bumps_in_perspective, regions
from torch.testing import assert_close


def test_normals_face_the_viewer_and_bulge_where_the_ball_does():
    normals, mask = ball(20)
    assert_close(normals.norm(dim=-1), torch.ones(20, 20, dtype=torch.float64))
    assert (normals[mask][:, 2] < 0).all()
    assert (normals[10, 15:][mask[10, 15:], 0] > 0).all()  # right of the centre: to the right
    assert not mask[0, 0]
    assert normals[mask][:, 2].max() < -torch.cos(torch.tensor(1.31))  # 75 degrees


def test_the_bumps_slopes_have_no_curl(generator):
    normals, _ = bumps(200, generator)
    p, q = (-normals[..., :2] / normals[..., 2:]).unbind(dim=-1)
    curl = torch.gradient(p)[0] - torch.gradient(q)[1]
    # Second differences of 200 pixels a side; a slope of one changes by about 0.02 a pixel.
    assert curl[1:-1, 1:-1].abs().max() < 1e-4
    assert torch.maximum(p.abs(), q.abs()).max() > 0.5


def test_the_normals_in_perspective_are_those_of_the_depth(generator):
    normals, mask, intrinsics, depth = bumps_in_perspective(200, generator)
    v, u = torch.meshgrid(torch.arange(200) + 0.5, torch.arange(200) + 0.5, indexing="ij")
    pixels = torch.stack([u, v, torch.ones_like(u)], dim=-1).double()
    points = depth[..., None] * (pixels @ torch.linalg.inv(intrinsics).mT)
    down, right = torch.gradient(points, dim=(0, 1))
    expected = torch.nn.functional.normalize(torch.linalg.cross(down, right), dim=-1)
    assert_close(normals[1:-1, 1:-1], expected[1:-1, 1:-1], atol=2e-4, rtol=0)
    assert ((normals * points).sum(dim=-1) < 0).all()
    assert mask.all()


def test_images_are_light_by_normal_by_albedo_without_negative_values(generator):
    normals, mask = ball(16)
    lights = point_lights(6, generator)
    made = photograph(normals, regions(16, generator), mask, lights, generator)
    values = made.images[..., mask]
    expected = (lights @ made.normals).clamp_min(0)[:, None] * made.albedo
    assert_close(values, expected)
    assert (made.images[..., ~mask] == 0).all()
    assert_close(made.images.sum(dim=1)[:, mask], (lights @ made.shading).clamp_min(0))
    noisy = photograph(normals, regions(16, generator), mask, lights, generator, noise=0.1)
    assert (noisy.images >= 0).all()
    assert (lights[:, 2] < -0.7 * torch.cos(torch.tensor(0.88))).all()  # 50 degrees
