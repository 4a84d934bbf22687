import torch
from torch.testing import assert_close

from pimper_bench.scenes.scene_cameras import arc_cameras
from pimper_torch.geometry.projection import project
from pimper_torch.stages.coarse.densify import DepthMaps
from pimper_torch.stages.coarse.oriented import count_contradictions, fitted_planes
from pimper_torch.stages.coarse.window_matching import MatchingLevel


def plane_round(depth, valid, row, column, step):
    """Fit the plane of a pixel's window by iteratively reweighted least squares."""
    window = depth[row - 2 : row + 3, column - 2 : column + 3].double()
    v, u = torch.meshgrid(*(torch.arange(-2.0, 3.0, dtype=torch.double),) * 2, indexing="ij")
    basis = torch.stack([torch.ones(25).double(), u.flatten(), v.flatten()], dim=1)
    away = (window - depth[row, column].double()).flatten() / step
    counted = valid[row - 2 : row + 3, column - 2 : column + 3].flatten().double()
    weight = counted * torch.exp(-(away / 3).square() / 2)
    for _ in range(3):
        normal = basis.T @ (weight[:, None] * basis) + 1e-3 * torch.eye(3).double()
        fit = torch.linalg.solve(normal, basis.T @ (weight * away))
        square = (away - basis @ fit).square()
        weight = counted * torch.exp(-square / 2)
    return fit, (weight * square).sum() / weight.sum(), weight.mean()


def test_planes_are_robust_least_squares_fits():
    generator = torch.Generator().manual_seed(0)
    rough = 0.001 * torch.randn(40, 53, generator=generator)
    depth = 0.3 + rough.cumsum(dim=0) / 4 + 0.05 * (torch.arange(53) > 30)
    valid = torch.rand(40, 53, generator=generator) > 0.2
    inverse_depth, slope, spread, fine = fitted_planes(depth, valid, 0.001)
    assert 0.1 < float(fine.double().mean()) < 0.8  # both cases occur
    pixels = (valid.nonzero() - torch.tensor([20, 26])).abs()
    inner = valid.nonzero()[(pixels < torch.tensor([18, 24])).all(dim=1)][::7]
    for row, column in inner.tolist():
        fit, variance, fraction = plane_round(depth, valid, row, column, 0.001)
        expected = depth[row, column].double() + 0.001 * fit[0]
        assert_close(inverse_depth[row, column].double(), expected, atol=1e-7, rtol=1e-5)
        assert_close(slope[row, column].double(), 0.001 * fit[1:], atol=1e-7, rtol=1e-5)
        scatter = 0.001 * variance.sqrt().clamp_min(0.05)
        assert_close(spread[row, column].double(), scatter, atol=1e-7, rtol=1e-5)
        if abs(fraction - 0.7) > 1e-4 and abs(abs(fit[0]) - 1) > 1e-4:
            assert bool(fine[row, column]) == bool(fraction > 0.7 and abs(fit[0]) < 1)


def test_invalid_pixels_have_no_plane():
    depth = torch.full((6, 7), 0.5)
    inverse_depth, slope, _, fine = fitted_planes(depth, torch.zeros_like(depth) > 0, 0.001)
    assert_close(inverse_depth, depth)
    assert not bool(slope.any())
    assert not bool(fine.any())


def test_points_are_contradicted_by_views_that_see_through_them():
    generator = torch.Generator().manual_seed(0)
    cameras = arc_cameras(5, width=40, height=30, focal_px=45.0, distance=4.0, sway_deg=10.0).to(
        torch.float32
    )
    tone = torch.ones(5, 30, 40)
    maps = DepthMaps(
        factor=1,
        level=MatchingLevel(tone=tone, usable=tone > 0, cameras=cameras),
        inverse_depth=0.25 + 0.02 * torch.randn(5, 30, 40, generator=generator),
        agreed=tone.long(),
        valid=torch.rand(5, 30, 40, generator=generator) > 0.2,
        step=torch.linspace(0.001, 0.01, 5),
        sources=torch.zeros(5, 2, dtype=torch.long),
    )
    # Some are outside every image, some behind cameras.
    points = 3 * torch.randn(5000, 3, generator=generator)
    found = count_contradictions(maps, 1, points)
    pixels, depth = project(points, cameras.cam_from_world, cameras.intrinsics)
    expected = torch.zeros_like(found)
    for view in (0, 2, 3, 4):
        for point, ((u, v), z) in enumerate(zip(pixels[view].tolist(), depth[view], strict=True)):
            if z > 0 and 0 <= u < 40 and 0 <= v < 30 and maps.valid[view, int(v), int(u)]:
                shown = maps.inverse_depth[view, int(v), int(u)]
                expected[point] += bool(1 / z > shown + 3 * maps.step[view])
    assert int(expected.max()) >= 3
    assert int((expected == 0).sum()) > 500
    assert float((found != expected).double().mean()) < 1e-3  # pixels within rounding
