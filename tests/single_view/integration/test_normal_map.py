import math

import pytest
import torch
from slopes import normals_from_slopes
from torch.nn.functional import normalize
from torch.testing import assert_close

from pimper_torch.geometry.pixels import homogeneous, pixel_centers
from pimper_torch.runtime.errors import InputError
from pimper_torch.single_view.integration import raster_system
from pimper_torch.single_view.integration.normal_map import integrate_normal_map
from pimper_torch.single_view.integration.raster_system import RasterSystem
from pimper_torch.single_view.integration.steps import orthographic_steps

ALL = pytest.mark.parametrize("method", ["discontinuities", "weighted"])


def centres(height, width, spacing=(1.0, 1.0)):
    x = (torch.arange(width).double() - (width - 1) / 2) * spacing[0]
    y = (torch.arange(height).double() - (height - 1) / 2) * spacing[1]
    return torch.meshgrid(x, y, indexing="xy")


def normals_of(p, q):
    return normals_from_slopes(torch.stack([p, q], dim=-1))


def bumps(width, height=None):
    """Return normals and depth of a closed-form surface over a square of side 2, and its grid."""
    height = height or width
    spacing = 2 / width, 2 / height
    x, y = centres(height, width, spacing)
    z = 0.3 * torch.sin(3 * x + 0.4) * torch.cos(2 * y) + 0.2 * x * y + 0.1 * x
    p = 0.9 * torch.cos(3 * x + 0.4) * torch.cos(2 * y) + 0.2 * y + 0.1
    q = -0.6 * torch.sin(3 * x + 0.4) * torch.sin(2 * y) + 0.2 * x
    return normals_of(p, q), z, {"spacing": spacing}


def pinhole(size):
    """Return a camera with non-square pixels, and the rays of its pixels."""
    K = [[1.5 * size, 0, size / 2 + 3], [0, 1.65 * size, size / 2 - 2], [0, 0, 1]]
    K = torch.tensor(K, dtype=torch.float64)
    return K, homogeneous(pixel_centers(size, size, K)) @ torch.linalg.inv(K).mT


def ball(size, away=4.0):
    """Return normals, depth and hit mask of a sphere in perspective, without its rim."""
    K, ray = pinhole(size)
    direction = normalize(ray, dim=-1)
    along = direction[..., 2] * away
    square = along**2 - away**2 + 1
    point = direction * (along - square.clamp_min(0).sqrt())[..., None]
    return point - point.new_tensor([0, 0, away]), point[..., 2], square > 0.1, K


def misfit(found, depth, mask=...):
    apart = (found.depth - depth)[mask]
    return float((apart - apart.mean()).abs().max())


@ALL
def test_the_error_falls_with_the_spacing(method):
    # The cubic is of fourth order, and of second order at borders.
    errors = []
    for size in (24, 48):
        normals, z, at = bumps(size)
        errors.append(misfit(integrate_normal_map(normals, **at, method=method), z))
    assert errors[0] < 1e-3
    assert errors[1] < errors[0] / 2**2.8
    normals, z, at = bumps(48, 30)  # pixels need not be square
    assert misfit(integrate_normal_map(normals, **at, method=method), z) < 2e-4


@ALL
def test_planes_are_reproduced_exactly(method):
    x, y = centres(9, 13, (0.5, 0.2))
    normals = normals_of(0 * x + 0.7, 0 * x - 0.4)
    found = integrate_normal_map(normals, spacing=(0.5, 0.2), method=method)
    assert_close(found.depth, 0.7 * x - 0.4 * y, rtol=0, atol=1e-9)
    K, rays = pinhole(20)
    normals = normals_of(*rays.new_tensor([0.4, 0.5])[:, None, None].expand(2, 20, 20))
    found = integrate_normal_map(normals[:16], intrinsics=K, method=method).depth
    ratio = found / (-1 / (rays * normals).sum(dim=-1))[:16]
    assert_close(ratio, ratio.mean().expand_as(ratio), rtol=1e-8, atol=0)
    assert float(found.log().mean()) == pytest.approx(0, abs=1e-9)


@ALL
def test_a_ball_in_perspective_has_errors_of_cubic_order(method):
    errors = []
    for size in (32, 64):
        normals, depth, mask, K = ball(size)
        found = integrate_normal_map(normals, mask, intrinsics=K, method=method)
        ratio = (found.depth / depth)[mask]
        errors.append(float((ratio / ratio.median() - 1).abs().mean()))
        assert (found.depth[~mask] == 0).all()
    assert errors[0] < 2e-4
    assert errors[1] < errors[0] / 6


@ALL
def test_rotating_the_raster_rotates_the_result(method):
    normals = bumps(16)[0][:, :11]
    rotated = normals.rot90(1, (0, 1))
    rotated = torch.stack([rotated[..., 1], -rotated[..., 0], rotated[..., 2]], dim=-1)
    straight = integrate_normal_map(normals, method=method)
    again = integrate_normal_map(rotated, method=method)
    assert_close(again.depth, straight.depth.rot90(1, (0, 1)), rtol=0, atol=1e-7)


@ALL
def test_empty_margins_do_not_change_the_result(method):
    normals, _, mask, K = ball(24)
    wide = torch.zeros(40, 50, 3).double(), torch.zeros(40, 50, dtype=torch.bool)
    wide[0][5:29, 20:44], wide[1][5:29, 20:44] = normals, mask
    moved = K + K.new_tensor([[0, 0, 20], [0, 0, 5], [0, 0, 0]])
    plain = integrate_normal_map(normals, mask, intrinsics=K, method=method)
    found = integrate_normal_map(*wide, intrinsics=moved, method=method)
    assert_close(found.depth[5:29, 20:44], plain.depth)
    assert (found.depth[~wide[1]] == 0).all()
    assert (found.valid[5:29, 20:44] == plain.valid).all()
    if found.continuity is not None:
        assert found.continuity.right.shape == (40, 49)
        assert_close(found.continuity.right[5:29, 20:43], plain.continuity.right)
        assert_close(found.continuity.down[5:28, 20:44], plain.continuity.down)


@ALL
def test_every_component_has_its_own_constant(method):
    normals, z, at = bumps(40)
    parts = torch.zeros(2, 40, 40, dtype=torch.bool)
    parts[0, 2:30, 2:30], parts[1, 34:38, 5:20] = True, True
    parts[0, 10:16, 10:16] = False
    mask = parts.any(dim=0)
    mask[33, 35] = True
    holed = torch.where(mask[..., None], normals, torch.nan)
    found = integrate_normal_map(holed, mask, **at, method=method)
    for part in parts:
        assert float(found.depth[part].mean()) == pytest.approx(0, abs=1e-9)
        assert misfit(found, z, part) < 3e-4
    assert float(found.depth[33, 35]) == 0
    assert (found.depth[~mask] == 0).all()
    assert (found.valid == mask).all()


@ALL
def test_missing_and_averted_normals_are_bridged_and_marked(method):
    normals, z, at = bumps(40)
    normals[20:23, 18:22] = torch.nan
    normals[5, 7] = 0
    normals[30, 9] = torch.tensor([0.6, 0, 0.8])
    normals[31, 30] = torch.tensor([1.0, 0, -1e-5])
    found = integrate_normal_map(normals, **at, method=method)
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
    q = torch.where(left & (y >= -8), slope, 0.1)
    generator = torch.Generator().manual_seed(3)
    wobble = noise * torch.randn(2, 40, 40, generator=generator, dtype=torch.float64)
    return normals_of(wobble[0], q + wobble[1]), z


@pytest.mark.parametrize(("noise", "bar"), [(0.0, 0.5), (0.05, 0.9)])
def test_depth_may_jump_where_the_surface_continues_around_the_jump(noise, bar):
    normals, z = cliff(noise)
    assert misfit(integrate_normal_map(normals, method="weighted"), z) > 4
    torn = integrate_normal_map(normals)
    assert misfit(torn, z) < bar
    assert (torn.continuity.right[30:, 19] < 0.05).all()
    assert torn.continuity.convergence.converged.all()


def test_rising_and_falling_stripes_are_separated_at_their_edges():
    # In plain least squares every stripe is flat: only the twist reveals its edges.
    x, y = centres(40, 48)
    up = (torch.arange(48) // 8 % 2 == 0).expand(40, 48)
    slope = torch.where(y > 0, 0.0, torch.where(up, 1.0, -1.0))
    found = integrate_normal_map(normals_of(0 * x, slope.double()))
    assert misfit(found, slope * y) < 0.5
    assert (found.continuity.right[:18, 7::8] < 0.01).all()
    assert (found.continuity.down[:18] > 0.9).all()


def test_noise_alone_does_not_tear_the_surface():
    generator = torch.Generator().manual_seed(8)
    wobble = 0.1 * torch.randn(2, 40, 40, generator=generator, dtype=torch.float64)
    normals = normals_of(*wobble)
    torn = integrate_normal_map(normals)
    kept = torch.cat([torn.continuity.right.flatten(), torn.continuity.down.flatten()])
    assert float((kept < 0.25).double().mean()) < 0.005
    smooth = integrate_normal_map(normals, method="weighted")
    assert float((torn.depth - smooth.depth).std()) < 0.1


def test_a_crease_is_not_a_jump():
    x, _ = centres(20, 41)
    found = integrate_normal_map(normals_of(torch.where(x < 0.5, 1.5, -1.5).double(), 0 * x))
    # The crease is somewhere between two pixels: the mean slope is as good as any.
    assert misfit(found, torch.where(x < 0.5, 1.5 * x, 1.5 - 1.5 * x)) < 0.8
    rows = found.depth - found.depth.mean(dim=1, keepdim=True)
    assert_close(rows, rows[:1].expand_as(rows), rtol=0, atol=1e-6)


def test_the_result_does_not_depend_on_the_linear_solver(monkeypatch):
    normals = cliff(0.02)[0][8:32, 8:32]
    exact = integrate_normal_map(normals)
    monkeypatch.setattr(raster_system, "_CHOLESKY_PIXELS", 0)
    iterated = integrate_normal_map(normals)
    assert_close(iterated.depth, exact.depth, rtol=0, atol=1e-5)
    assert_close(iterated.continuity.right, exact.continuity.right, rtol=0, atol=1e-5)


@ALL
def test_known_depths_fix_the_constant_and_deform_the_surface(method):
    normals, z, at = bumps(30)
    known = torch.full_like(z, torch.nan)
    known[4, 5], known[20, 25] = z[4, 5] + 7, z[20, 25] + 7
    found = integrate_normal_map(normals, **at, known_depth=known, method=method)
    assert_close(found.depth, z + 7, rtol=0, atol=2e-3)
    known[20, 25] += 0.5
    lift = []
    for weight in (1.0, 1e-6):
        given = {"known_depth": known, "weight": torch.full_like(z, weight), "method": "weighted"}
        apart = integrate_normal_map(normals, **at, **given).depth - z
        lift.append(float(apart[20, 25] - apart[4, 5]))
    assert 0.02 < lift[0] < 0.45
    assert lift[1] == pytest.approx(0.5, abs=1e-3)


def test_normals_with_low_weight_yield():
    normals, z, at = bumps(30)
    normals[10:14, 10:14] = normalize(torch.tensor([1.0, 1.0, -1.0]).double(), dim=0)
    around = torch.ones(30, 30, dtype=torch.bool)
    around[10:14, 10:14] = False
    found = [
        integrate_normal_map(
            normals, **at, weight=torch.where(around, 1.0, weight), method="weighted"
        )
        for weight in (1.0, 1e-4, 0.0)
    ]
    assert misfit(found[0], z, around) > 0.03
    assert misfit(found[1], z, around) < 1e-3
    assert misfit(found[2], z) < 0.02
    assert not found[2].valid[~around].any()


def test_gradients_reach_normals_weights_and_known_depths():
    normals, z, _ = bumps(4)
    weight = torch.linspace(0.5, 1, 16).double().reshape(4, 4).requires_grad_()
    slopes = (-normals[..., :2] / normals[..., 2:]).requires_grad_()

    def depth(slopes, weight, known):
        upright = torch.cat([slopes, -torch.ones_like(slopes[..., :1])], dim=-1)
        given = {"weight": weight, "known_depth": known, "method": "weighted"}
        return integrate_normal_map(upright, **given).depth

    leaves = slopes, weight, z.clone().requires_grad_()
    assert torch.autograd.gradcheck(depth, leaves, atol=1e-6)


def test_gradients_treat_continuity_as_constant():
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


def test_a_map_whose_normals_all_fail_is_flat_and_not_valid():
    found = integrate_normal_map(torch.full((5, 6, 3), math.nan))
    assert (found.depth == 0).all()
    assert not found.valid.any()


def test_float32_arrays_and_byte_masks_are_accepted():
    normals, _, mask, _ = ball(40)
    found = integrate_normal_map(normals.numpy(), mask.numpy().astype("uint8") * 255).depth
    assert torch.equal(found, integrate_normal_map(normals, mask).depth)
    single = integrate_normal_map(normals.float(), mask).depth
    assert single.dtype == torch.float32
    assert_close(single, found.float(), atol=1e-4, rtol=0)


OPENGL = torch.tensor([1.0, -1, -1]).double()


@pytest.mark.parametrize(
    ("change", "given", "needed"),
    [
        (lambda n: n * OPENGL, {}, "100% have z tow"),
        (lambda n: 0.5 + 0.5 * n * OPENGL, {}, "decode them as 2 n - 1"),
        (lambda n: n[..., :2], {}, r"of shape \(40, 40, 2\); needed: floating point"),
        (lambda n: (127 * n).to(torch.int8), {}, "normals are int8"),
        (lambda n: n, {"mask": torch.zeros(40, 40, dtype=torch.bool)}, "mask is empty"),
        (lambda n: n, {"mask": torch.ones(40, 41, dtype=torch.bool)}, "needed: one size"),
        (lambda n: n, {"weight": -torch.ones(40, 40)}, "1600 values"),
        (
            lambda n: n,
            {"known_depth": torch.zeros(40, 40), "intrinsics": torch.eye(3)},
            "not positive",
        ),
        (lambda n: n, {"spacing": (1.0, 0.0)}, "spacing"),
    ],
)
def test_invalid_input_and_different_conventions_are_rejected(change, given, needed):
    normals, _, mask, _ = ball(40)
    with pytest.raises(InputError, match=needed):
        integrate_normal_map(change(normals), **{"mask": mask, **given})
