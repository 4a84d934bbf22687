import pytest
import torch
from reliefs import align_reliefs
from torch.testing import assert_close

from pimper_torch.runtime.errors import InputError
from pimper_torch.single_view.photometric_stereo.integrability import (
    curls,
    integrable,
    wedge,
)


def even(scene):
    return torch.ones(scene.columns.shape[1], dtype=torch.float64)


def test_the_bivectors_of_a_product_are_the_product_of_the_bivectors(generator):
    u, v = torch.randn(2, 7, 4, generator=generator, dtype=torch.float64)
    a, b = torch.randn(2, 4, generator=generator, dtype=torch.float64)
    direct = (u @ a) * (v @ b) - (u @ b) * (v @ a)
    assert_close(wedge(u, v) @ wedge(a, b), direct)
    assert_close(wedge(u, v), -wedge(v, u))


def test_a_surface_is_found_up_to_bas_relief_whatever_its_albedo(
    bumpy, generator, patchwork, angles_deg
):
    mixing = torch.randn(3, 3, generator=generator, dtype=torch.float64)
    for albedo in (even(bumpy), patchwork(bumpy)):
        pseudo = mixing @ (albedo * bumpy.columns)
        found = integrable(pseudo, even(bumpy), bumpy.mask)
        shading = found @ pseudo
        best = align_reliefs(shading, bumpy.columns, even(bumpy)).on_shading(shading)
        # Over cells of 1/56 of the surface its slopes are not quite linear.
        assert angles_deg(best, bumpy.columns).mean() < 0.5
        assert (shading[2] < 0).double().mean() > 0.9


def test_pixels_outside_the_mask_or_without_weight_do_not_enter(bumpy, generator):
    weight = even(bumpy)
    ill = torch.rand(len(weight), generator=generator) < 0.01
    weight[ill] = 0
    spoilt = bumpy.columns.clone()
    spoilt[:, ill] = 100.0
    clean = curls(bumpy.columns, weight, bumpy.mask)
    same = curls(spoilt, weight, bumpy.mask)
    assert_close(same.across, clean.across)
    assert_close(same.down, clean.down)
    # No difference reaches over the hole or the cut corner: two planes with a ridge between
    # them would show it.
    mask = torch.ones(40, 41, dtype=torch.bool)
    mask[:, 20] = False
    left = torch.tensor([0.5, 0.1, -1.0], dtype=torch.float64)
    right = torch.tensor([-0.5, 0.3, -1.0], dtype=torch.float64)
    raster = torch.where((torch.arange(41) < 20)[None, :, None], left, right).expand(40, 41, 3)
    found = curls(raster[mask].mT, torch.ones(int(mask.sum()), dtype=torch.float64), mask)
    assert found.across.abs().max() == 0


def test_depth_edges_are_outliers(bumpy, angles_deg):
    # One half of the surface leans against the other: no surface crosses the line between.
    normals = bumpy.normals.clone()
    normals[:, 28:, 0] += 0.7 * normals[:, 28:, 2]
    pseudo = normals[bumpy.mask].mT
    shading = integrable(pseudo, even(bumpy), bumpy.mask) @ pseudo
    best = align_reliefs(shading, pseudo, even(bumpy)).on_shading(shading)
    assert angles_deg(best, pseudo).mean() < 0.5


def test_planes_and_cylinders_are_refused():
    mask = torch.ones(40, 40, dtype=torch.bool)
    x = torch.linspace(-1, 1, 40, dtype=torch.float64).expand(40, 40)
    ones = torch.ones_like(x)
    for slope in (0 * x, 0.5 * x + 0.3 * x**2):
        normals = torch.stack([slope, 0.2 * ones, -ones])[:, mask]
        with pytest.raises(InputError, match="more than one matrix"):
            integrable(normals, torch.ones(1600, dtype=torch.float64), mask)


def test_too_few_pixels_are_refused(bumpy):
    mask = torch.zeros_like(bumpy.mask)
    mask[10:13, 10:13] = True
    with pytest.raises(InputError, match="Widen the mask"):
        integrable(bumpy.normals[mask].mT, torch.ones(9, dtype=torch.float64), mask)
