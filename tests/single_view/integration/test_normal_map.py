import math

import pytest
import torch
from torch.nn.functional import normalize
from torch.testing import assert_close

from pimper_torch.runtime.errors import InputError
from pimper_torch.single_view.integration import raster_system
from pimper_torch.single_view.integration.normal_map import integrate_normal_map
from pimper_torch.single_view.integration.raster_system import RasterSystem
from pimper_torch.single_view.integration.steps import orthographic_steps

ALL = ["discontinuities", "weighted"]


def centres(height, width, spacing=(1.0, 1.0)):
    x = (torch.arange(width).double() - (width - 1) / 2) * spacing[0]
    y = (torch.arange(height).double() - (height - 1) / 2) * spacing[1]
    return torch.meshgrid(x, y, indexing="xy")


def bumps(size, spacing=None):
    """A closed-form surface over a square of side 2, and its normals."""
    spacing = spacing or (2 / size, 2 / size)
    x, y = centres(round(2 / spacing[1]), round(2 / spacing[0]), spacing)
    z = 0.3 * torch.sin(3 * x + 0.4) * torch.cos(2 * y) + 0.2 * x * y + 0.1 * x
    p = 0.9 * torch.cos(3 * x + 0.4) * torch.cos(2 * y) + 0.2 * y + 0.1
    q = -0.6 * torch.sin(3 * x + 0.4) * torch.sin(2 * y) + 0.2 * x
    normals = normalize(torch.stack([p, q, -torch.ones_like(p)], dim=-1), dim=-1)
    return normals, z


def pinhole(size):
    focal = 1.5 * size
    return torch.tensor(
        [[focal, 0, size / 2 + 3], [0, 1.1 * focal, size / 2 - 2], [0, 0, 1]]
    ).double()


def rays(K, height, width):
    u, v = torch.meshgrid(
        torch.arange(width).double() + 0.5, torch.arange(height).double() + 0.5, indexing="xy"
    )
    return torch.stack(
        [(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], torch.ones_like(u)], dim=-1
    )


def ball(size, radius=1.0, away=4.0):
    """A sphere before a pinhole: normals, depth and where it is met, the rim left out."""
    K = pinhole(size)
    ray = rays(K, size, size)
    direction = normalize(ray, dim=-1)
    along = direction[..., 2] * away
    square = along**2 - away**2 + radius**2
    point = direction * (along - square.clamp_min(0).sqrt())[..., None]
    normals = (point - point.new_tensor([0, 0, away])) / radius
    return normals, point[..., 2], square > 0.1, K


def misfit(found, depth, mask=None):
    mask = torch.ones_like(depth, dtype=torch.bool) if mask is None else mask
    apart = (found.depth - depth)[mask]
    return float((apart - apart.mean()).abs().max())


@pytest.mark.parametrize("method", ALL)
def test_the_error_falls_with_the_spacing(method):
    # The cubic is of fourth order, of second at borders.
    errors = []
    for size in (24, 48):
        normals, z = bumps(size)
        found = integrate_normal_map(normals, spacing=(2 / size, 2 / size), method=method)
        errors.append(misfit(found, z))
    assert errors[0] < 1e-3
    assert errors[1] < errors[0] / 2**2.8


@pytest.mark.parametrize("method", ALL)
def test_any_plane_comes_back_exactly(method):
    x, y = centres(9, 13, (0.5, 0.2))
    normals = normalize(torch.tensor([0.7, -0.4, -1.0], dtype=torch.float64), dim=0).expand(
        9, 13, 3
    )
    found = integrate_normal_map(normals, spacing=(0.5, 0.2), method=method)
    assert_close(found.depth, 0.7 * x - 0.4 * y, rtol=0, atol=1e-9)


@pytest.mark.parametrize("method", ALL)
def test_a_plane_before_a_pinhole_comes_back_exactly(method):
    K = pinhole(20)
    normal = normalize(torch.tensor([0.4, 0.5, -1.0], dtype=torch.float64), dim=0)
    depth = -3 / (rays(K, 16, 20) @ normal)
    normals = normal.expand(16, 20, 3)
    found = integrate_normal_map(normals, intrinsics=K, method=method)
    ratio = found.depth / depth
    assert_close(ratio, ratio.mean().expand_as(ratio), rtol=1e-8, atol=0)
    assert float(found.depth.log().mean()) == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("method", ALL)
def test_a_ball_before_a_pinhole_comes_back_with_the_order_of_the_cubic(method):
    errors = []
    for size in (32, 64):
        normals, depth, mask, K = ball(size)
        found = integrate_normal_map(normals, mask, intrinsics=K, method=method)
        ratio = (found.depth / depth)[mask]
        errors.append(float((ratio / ratio.median() - 1).abs().mean()))
        assert (found.depth[~mask] == 0).all()
    assert errors[0] < 2e-4
    assert errors[1] < errors[0] / 6


@pytest.mark.parametrize("method", ALL)
def test_turning_the_raster_turns_the_answer(method):
    normals, _ = bumps(16)
    normals = normals[:, :11]
    rotated = normals.rot90(1, (0, 1))
    rotated = torch.stack([rotated[..., 1], -rotated[..., 0], rotated[..., 2]], dim=-1)
    straight = integrate_normal_map(normals, method=method)
    again = integrate_normal_map(rotated, method=method)
    assert_close(again.depth, straight.depth.rot90(1, (0, 1)), rtol=0, atol=1e-7)


@pytest.mark.parametrize("method", ALL)
def test_empty_margins_change_nothing(method):
    normals, _, mask, K = ball(24)
    wide = torch.zeros(40, 50, 3).double(), torch.zeros(40, 50, dtype=torch.bool)
    wide[0][5:29, 20:44], wide[1][5:29, 20:44] = normals, mask
    moved = K.clone()
    moved[0, 2] += 20
    moved[1, 2] += 5
    plain = integrate_normal_map(normals, mask, intrinsics=K, method=method)
    found = integrate_normal_map(*wide, intrinsics=moved, method=method)
    assert_close(found.depth[5:29, 20:44], plain.depth)
    assert (found.depth[~wide[1]] == 0).all()
    assert (found.valid[5:29, 20:44] == plain.valid).all()
    if found.continuity is not None:
        assert found.continuity.right.shape == (40, 49)
        assert_close(found.continuity.right[5:29, 20:43], plain.continuity.right)
        assert_close(found.continuity.down[5:28, 20:44], plain.continuity.down)


@pytest.mark.parametrize("method", ALL)
def test_pixels_need_not_be_square(method):
    normals, z = bumps(0, spacing=(2 / 48, 2 / 30))
    found = integrate_normal_map(normals, spacing=(2 / 48, 2 / 30), method=method)
    assert misfit(found, z) < 2e-4


@pytest.mark.parametrize("method", ALL)
def test_holes_islands_and_single_pixels_each_have_their_own_constant(method):
    normals, z = bumps(40)
    mask = torch.zeros(40, 40, dtype=torch.bool)
    mask[2:30, 2:30] = True
    mask[10:16, 10:16] = False
    mask[34:38, 5:20] = True
    mask[33, 35] = True
    found = integrate_normal_map(
        torch.where(mask[..., None], normals, torch.nan),
        mask,
        spacing=(0.05, 0.05),
        method=method,
    )
    parts = torch.zeros_like(mask), torch.zeros_like(mask)
    parts[0][2:30, 2:30], parts[1][34:38, 5:20] = True, True
    for part in parts:
        part &= mask
        assert float(found.depth[part].mean()) == pytest.approx(0, abs=1e-9)
        assert misfit(found, z, part) < 3e-4
    assert float(found.depth[33, 35]) == 0
    assert (found.depth[~mask] == 0).all()
    assert (found.valid == mask).all()


@pytest.mark.parametrize("method", ALL)
def test_missing_and_turned_away_normals_are_bridged_and_say_so(method):
    normals, z = bumps(40)
    spoilt = normals.clone()
    spoilt[20:23, 18:22] = torch.nan
    spoilt[5, 7] = 0
    spoilt[30, 9] = torch.tensor([0.6, 0, 0.8])
    spoilt[31, 30] = torch.tensor([1.0, 0, -1e-5])
    found = integrate_normal_map(spoilt, spacing=(0.05, 0.05), method=method)
    assert int((~found.valid).sum()) == 15
    assert not found.valid[[20, 5, 30, 31], [18, 7, 9, 30]].any()
    assert misfit(found, z, found.valid) < 2e-3
    assert misfit(found, z) < 0.01


def cliff(noise=0.0):
    """A tilted floor and, on the left part of a step 6 pixels high, a slope that joins both.

    Depth jumps along the line between columns 19 and 20, from row 12 on; above it the surface
    is continuous, so that normals determine everything.
    """
    x, y = centres(40, 40)
    ramp = torch.where(y < -8, 0.0, torch.where(y < 4, (y + 8) ** 2 / 24, (y + 8 - 6) * 1.0))
    slope = torch.where(y < -8, 0.0, torch.where(y < 4, (y + 8) / 12, 1.0))
    left = x < 0
    z = torch.where(left, ramp, 0.1 * y)
    z = torch.where(y < -8, 0.1 * y, z + torch.where(left, -0.8, 0))
    p = torch.zeros_like(z)
    q = torch.where(left & (y >= -8), slope, 0.1)
    generator = torch.Generator().manual_seed(3)
    wobble = noise * torch.randn(2, 40, 40, generator=generator, dtype=torch.float64)
    normals = torch.stack([p + wobble[0], q + wobble[1], -torch.ones_like(p)], dim=-1)
    return normalize(normals, dim=-1), z


@pytest.mark.parametrize(("noise", "bar"), [(0.0, 0.5), (0.05, 0.9)])
def test_depth_may_jump_where_the_surface_goes_round_the_jump(noise, bar):
    normals, z = cliff(noise)
    smooth = integrate_normal_map(normals, method="weighted")
    torn = integrate_normal_map(normals)
    assert misfit(smooth, z) > 4
    assert misfit(torn, z) < bar
    jump = torn.continuity.right[:, 19]
    assert (jump[30:] < 0.05).all()
    assert torn.continuity.convergence.converged.all()


def test_stripes_that_rise_and_sink_come_apart_along_their_sides():
    # From plain least squares alone every stripe looks flat: only the twist tells its sides.
    x, y = centres(40, 48)
    up = (torch.arange(48) // 8 % 2 == 0).expand(40, 48)
    slope = torch.where(y > 0, 0.0, torch.where(up, 1.0, -1.0))
    normals = torch.stack([torch.zeros_like(x), slope, -torch.ones_like(x)], dim=-1)
    found = integrate_normal_map(normals)
    assert misfit(found, slope * y) < 0.5
    sides = found.continuity.right[:18, 7::8]
    assert (sides < 0.01).all()
    assert (found.continuity.down[:18] > 0.9).all()


def test_noise_alone_does_not_tear_the_surface():
    generator = torch.Generator().manual_seed(8)
    wobble = 0.1 * torch.randn(2, 40, 40, generator=generator, dtype=torch.float64)
    normals = normalize(torch.cat([wobble, -torch.ones(1, 40, 40).double()]).movedim(0, -1), dim=-1)
    torn = integrate_normal_map(normals)
    kept = torch.cat([torn.continuity.right.flatten(), torn.continuity.down.flatten()])
    assert float((kept < 0.25).double().mean()) < 0.005
    smooth = integrate_normal_map(normals, method="weighted")
    assert float((torn.depth - smooth.depth).std()) < 0.1


def test_a_crease_is_no_jump():
    x, _ = centres(20, 41)
    slope = torch.where(x < 0.5, 1.5, -1.5)
    normals = torch.stack([slope, torch.zeros_like(x), -torch.ones_like(x)], dim=-1)
    found = integrate_normal_map(normals)
    # The crease lies somewhere on the step between two pixels: the mean slope is as good as any.
    assert misfit(found, torch.where(x < 0.5, 1.5 * x, 1.5 - 1.5 * x)) < 0.8
    rows = found.depth - found.depth.mean(dim=1, keepdim=True)
    assert_close(rows, rows[:1].expand_as(rows), rtol=0, atol=1e-6)


def test_the_answer_does_not_depend_on_how_linear_systems_are_solved(monkeypatch):
    normals = cliff(0.02)[0][8:32, 8:32]
    exact = integrate_normal_map(normals)
    monkeypatch.setattr(raster_system, "_CHOLESKY_PIXELS", 0)
    iterated = integrate_normal_map(normals)
    assert_close(iterated.depth, exact.depth, rtol=0, atol=1e-5)
    assert_close(iterated.continuity.right, exact.continuity.right, rtol=0, atol=1e-5)


@pytest.mark.parametrize("method", ALL)
def test_known_depths_fix_the_constant_and_bend_what_normals_say(method):
    normals, z = bumps(30)
    known = torch.full_like(z, torch.nan)
    known[4, 5], known[20, 25] = z[4, 5] + 7, z[20, 25] + 7
    found = integrate_normal_map(
        normals, spacing=(2 / 30, 2 / 30), known_depth=known, method=method
    )
    assert_close(found.depth, z + 7, rtol=0, atol=2e-3)
    known[20, 25] += 0.5
    bent, held = (
        integrate_normal_map(
            normals,
            spacing=(2 / 30, 2 / 30),
            known_depth=known,
            weight=torch.full_like(z, 1 / weight),
            method="weighted",
        )
        for weight in (1.0, 1e6)
    )
    lift = [float((one.depth - z - 7)[20, 25] - (one.depth - z - 7)[4, 5]) for one in (bent, held)]
    assert 0.02 < lift[0] < 0.45
    assert lift[1] == pytest.approx(0.5, abs=1e-3)


def test_normals_that_are_not_trusted_yield():
    normals, z = bumps(30)
    spoilt = normals.clone()
    spoilt[10:14, 10:14] = normalize(torch.tensor([1.0, 1.0, -1.0]).double(), dim=0)
    weight = torch.ones(30, 30).double()
    weight[10:14, 10:14] = 1e-4
    reliable, not_reliable = (
        integrate_normal_map(spoilt, spacing=(2 / 30, 2 / 30), weight=one, method="weighted")
        for one in (None, weight)
    )
    around = weight == 1
    assert misfit(reliable, z, around) > 0.03
    assert misfit(not_reliable, z, around) < 1e-3
    zero = weight.clone()
    zero[10:14, 10:14] = 0
    bridged = integrate_normal_map(spoilt, spacing=(2 / 30, 2 / 30), weight=zero)
    assert misfit(bridged, z) < 0.02
    assert not bridged.valid[10:14, 10:14].any()


@pytest.mark.parametrize("method", ALL[1:])
def test_gradients_reach_the_normals(method):
    normals, _ = bumps(5)

    def depth(slopes):
        down = -torch.ones_like(slopes[..., :1])
        found = integrate_normal_map(torch.cat([slopes, down], dim=-1), method=method)
        return found.depth

    slopes = (-normals[..., :2] / normals[..., 2:]).requires_grad_()
    assert torch.autograd.gradcheck(depth, slopes, atol=1e-6)


def test_gradients_take_continuity_as_given():
    normals, _ = cliff(0.02)
    slopes = (-normals[..., :2] / normals[..., 2:]).requires_grad_()

    def upright(slopes):
        return torch.cat([slopes, -torch.ones_like(slopes[..., :1])], dim=-1)

    found = integrate_normal_map(upright(slopes))
    (into,) = torch.autograd.grad(found.depth[33, 4] - found.depth[30, 30], slopes)
    steps = orthographic_steps(upright(slopes), torch.ones(40, 40, dtype=torch.bool))
    system = RasterSystem(found.continuity.right, found.continuity.down)
    again = system.fit_steps(*steps.target)
    (expected,) = torch.autograd.grad(again[33, 4] - again[30, 30], slopes)
    assert_close(into, expected, rtol=1e-5, atol=1e-7)
    assert into.abs().max() > 0.1


def test_gradients_reach_weights_and_known_depths():
    normals, z = bumps(4)
    weight = torch.linspace(0.5, 1, 16).double().reshape(4, 4).requires_grad_()
    known = z.clone().requires_grad_()

    def depth(weight, known):
        return integrate_normal_map(
            normals, weight=weight, known_depth=known, method="weighted"
        ).depth

    assert torch.autograd.gradcheck(depth, (weight, known))


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"mask": torch.zeros(6, 6, dtype=torch.bool)}, "no pixel"),
        ({"weight": -torch.ones(6, 6)}, "36 values"),
        ({"known_depth": torch.zeros(6, 6), "intrinsics": torch.eye(3)}, "not positive"),
        ({"spacing": (1.0, 0.0)}, "spacing"),
    ],
)
def test_input_that_means_nothing_is_refused(change, text):
    normals = torch.tensor([0.0, 0, -1]).expand(6, 6, 3)
    with pytest.raises(InputError, match=text):
        integrate_normal_map(normals, **change)


def test_a_map_whose_normals_all_fail_is_flat_and_not_valid():
    found = integrate_normal_map(torch.full((5, 6, 3), math.nan))
    assert (found.depth == 0).all()
    assert not found.valid.any()


def dome(side=160):
    line = torch.linspace(-1.05, 1.05, side, dtype=torch.float64)
    y, x = torch.meshgrid(line, line, indexing="ij")
    depth = -(1 - x**2 - y**2).clamp_min(1e-9).sqrt()
    return torch.stack([x, y, depth], dim=-1), x**2 + y**2 < 0.9, depth


def test_arrays_and_masks_of_bytes_are_taken():
    normals, mask, _ = dome(40)
    found = integrate_normal_map(normals.numpy(), mask.numpy().astype("uint8") * 255).depth
    expected = integrate_normal_map(normals, mask).depth
    assert torch.equal(found, expected)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (
            lambda n: n * torch.tensor([1.0, -1, -1]).double(),
            "100% of them have z tow",
        ),
        (lambda n: 0.5 + 0.5 * n * torch.tensor([1.0, -1, -1]).double(), "decode them as 2 n - 1"),
        (lambda n: n[..., :2], r"of shape \(40, 40, 2\); needed: floating point, height width 3"),
        (lambda n: (127 * n).to(torch.int8), "normals are int8"),
    ],
)
def test_normals_of_another_convention_are_refused(change, told):
    normals, mask, _ = dome(40)
    with pytest.raises(InputError, match=told):
        integrate_normal_map(change(normals), mask)


def test_float32_normals_give_float32_depth():
    normals, z = bumps(20)
    found = integrate_normal_map(normals.float(), spacing=(0.1, 0.1))
    assert found.depth.dtype == torch.float32
    assert misfit(found, z.float()) < 3e-3
