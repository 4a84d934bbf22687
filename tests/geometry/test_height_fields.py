import torch
from torch.nn.functional import normalize
from torch.testing import assert_close

from pimper_torch.geometry.height_fields import intersect_height_field, sample_raster


def raster(spacing, half_width=1.0):
    side = round(2 * half_width / spacing) + 1
    axis = -half_width + spacing * torch.arange(side, dtype=torch.float64)
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    origin = torch.full((1, 2), -half_width, dtype=torch.float64)
    return x[None], y[None], origin, torch.tensor([spacing], dtype=torch.float64)


def oblique_rays(count, generator, spread=0.5):
    starts = torch.rand(1, count, 3, generator=generator, dtype=torch.float64) - 0.5
    along = torch.randn(1, count, 3, generator=generator, dtype=torch.float64) * spread
    along[..., 2] = 1
    return starts * torch.tensor([1.0, 1.0, 0.2], dtype=torch.float64), along


def test_lookup_reproduces_a_bilinear_function_off_the_samples(generator):
    x, y, origin, spacing = raster(0.25)
    values = torch.stack([1 + 2 * x - 3 * y + x * y, x - y], dim=1)
    xy = 2 * torch.rand(1, 50, 2, generator=generator, dtype=torch.float64) - 1
    found = sample_raster(values, xy, origin, spacing)
    px, py = xy[..., 0], xy[..., 1]
    assert_close(found, torch.stack([1 + 2 * px - 3 * py + px * py, px - py], dim=1))


def test_lookup_has_columns_along_x_from_the_origin_of_each_patch():
    values = torch.arange(12.0, dtype=torch.float64).reshape(1, 1, 3, 4).repeat(2, 1, 1, 1)
    origin = torch.tensor([[0.0, 0.0], [10.0, -5.0]], dtype=torch.float64)
    spacing = torch.tensor([1.0, 0.5], dtype=torch.float64)
    xy = torch.tensor([[[2.0, 1.0]], [[11.0, -4.5]]], dtype=torch.float64)
    assert_close(sample_raster(values, xy, origin, spacing).flatten(), values[0, 0, 1, 2].repeat(2))


def test_lookup_ignores_invalid_samples():
    values = torch.tensor([[[[1.0, torch.nan], [1.0, 3.0]]]], dtype=torch.float64)
    valid = values[:, 0].isfinite()
    origin, spacing = torch.zeros(1, 2).double(), torch.ones(1).double()
    xy = torch.tensor([[[0.5, 0.0], [0.5, 1.0]]], dtype=torch.float64)
    found = sample_raster(values, xy, origin, spacing, valid=valid)
    assert_close(found.flatten(), torch.tensor([1.0, 2.0], dtype=torch.float64))


def test_rays_meet_a_tilted_plane_exactly_after_one_step(generator):
    x, y, origin, spacing = raster(0.1)
    depth = 0.1 + 0.3 * x - 0.2 * y
    starts, along = oblique_rays(40, generator, spread=0.3)
    points, hit = intersect_height_field(
        depth, torch.ones_like(depth, dtype=torch.bool), origin, spacing, starts, along, steps=1
    )
    assert hit.sum() >= 35
    normal = torch.tensor([0.3, -0.2, -1.0], dtype=torch.float64)
    gap = points @ normal + 0.1
    assert_close(gap[hit], torch.zeros_like(gap[hit]), atol=1e-12, rtol=0)
    crossed = torch.linalg.cross(points - starts, along)
    assert_close(crossed, torch.zeros_like(crossed), atol=1e-12, rtol=0)


def test_rays_meet_a_sphere_with_an_error_of_second_order_in_the_spacing(generator):
    radius = 2.0
    starts, along = oblique_rays(200, generator)
    along = -along  # only the line matters, not its sense
    worst = []
    for step in (0.1, 0.05):
        x, y, origin, spacing = raster(step)
        depth = radius - (radius**2 - x**2 - y**2).sqrt()
        valid = torch.ones_like(depth, dtype=torch.bool)
        points, hit = intersect_height_field(depth, valid, origin, spacing, starts, along, steps=4)
        assert hit.sum() >= 150
        center = torch.tensor([0.0, 0.0, radius], dtype=torch.float64)
        # Closed form: |o + t d - c| = R, the root closer to the plane z = 0.
        d = normalize(along, dim=-1)
        oc = starts - center
        b, c = (oc * d).sum(-1), (oc * oc).sum(-1) - radius**2
        root = (b * b - c).sqrt()
        expected = torch.stack([starts + (-b + s * root)[..., None] * d for s in (-1, 1)])
        expected = torch.where(
            (expected[0, ..., 2].abs() < expected[1, ..., 2].abs())[..., None], *expected
        )
        worst.append((points - expected).norm(dim=-1)[hit].max())
    # Interpolation: h^2 / 8 times the second derivatives, 2.1 at the corners, seen obliquely.
    assert worst[0] < 0.4 * 0.1**2
    assert worst[1] < 0.3 * worst[0]


def test_a_ray_hits_only_if_all_interpolated_samples_are_valid():
    x, _, origin, spacing = raster(0.5)
    valid = x < 0.25
    depth = torch.where(valid, 0.0, torch.nan)
    starts = torch.zeros(1, 5, 3, dtype=torch.float64)
    starts[0, :, 0] = torch.tensor([-0.3, 0.0, 0.3, 0.8, -1.2])
    down = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand_as(starts)
    points, hit = intersect_height_field(depth, valid, origin, spacing, starts, down)
    assert hit.tolist() == [[True, True, False, False, False]]
    assert points.isfinite().all()


def test_a_ray_along_the_height_field_misses():
    x, _, origin, spacing = raster(0.5)
    depth = torch.zeros_like(x)
    start = torch.tensor([[[0.0, 0.0, 0.3], [0.0, 0.0, 0.0]]], dtype=torch.float64)
    along = torch.tensor([[[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]], dtype=torch.float64)
    points, hit = intersect_height_field(depth, depth == 0, origin, spacing, start, along)
    assert not hit.any()
    assert points.isfinite().all()


def test_intersections_have_implicit_gradients(generator):
    x, y, origin, spacing = raster(0.5)
    depth = (0.1 * x * x + 0.05 * y * x).requires_grad_()
    starts, along = oblique_rays(6, generator, spread=0.3)
    starts[..., :2] *= 0.9
    starts.requires_grad_()
    along.requires_grad_()
    valid = torch.ones_like(x, dtype=torch.bool)

    def meet(depth, starts, along):
        points, hit = intersect_height_field(depth, valid, origin, spacing, starts, along, steps=12)
        return points[hit]

    assert torch.autograd.gradcheck(meet, (depth, starts, along), atol=1e-6)
