import pytest
import torch
from reliefs import align_reliefs
from torch.testing import assert_close

from pimper_torch.runtime.errors import InputError
from pimper_torch.single_view.photometric_stereo.integrability import curls, integrable, wedge
from tests.single_view.scenes import BUMPY, angles_deg


def off_deg(pseudo, true):
    """Return the mean error after the best bas-relief transformation."""
    shading = integrable(pseudo, BUMPY.even, BUMPY.mask) @ pseudo
    assert (shading[2] < 0).double().mean() > 0.9
    best = align_reliefs(shading, true, BUMPY.even).on_shading(shading)
    return angles_deg(best, true).mean()


def test_bivectors_of_a_product_are_the_product_of_bivectors(generator):
    u, v = torch.randn(2, 7, 3, generator=generator, dtype=torch.float64)
    a, b = torch.randn(2, 3, generator=generator, dtype=torch.float64)
    assert_close(wedge(u, v) @ wedge(a, b), (u @ a) * (v @ b) - (u @ b) * (v @ a))


def test_a_surface_is_recovered_up_to_bas_relief_for_any_albedo(generator):
    mixing = torch.randn(3, 3, generator=generator, dtype=torch.float64)
    for albedo in (BUMPY.even, BUMPY.patchwork):
        # Slopes are not exactly linear over cells of 1/56 of the surface.
        assert off_deg(mixing @ (albedo * BUMPY.columns), BUMPY.columns) < 0.5


def test_depth_edges_are_outliers():
    # The halves of the surface are tilted against each other: it is discontinuous between them.
    normals = BUMPY.normals.clone()
    normals[:, 28:, 0] += 0.7 * normals[:, 28:, 2]
    pseudo = normals[BUMPY.mask].mT
    assert off_deg(pseudo, pseudo) < 0.5


def test_pixels_outside_the_mask_or_without_weight_are_ignored(generator):
    weight, spoilt = BUMPY.even, BUMPY.columns.clone()
    ill = torch.rand(len(weight), generator=generator) < 0.01
    weight[ill], spoilt[:, ill] = 0, 100.0
    clean, same = (curls(pseudo, weight, BUMPY.mask) for pseudo in (BUMPY.columns, spoilt))
    assert_close((same.across, same.down), (clean.across, clean.down))
    # No difference crosses a gap; it would be visible for two planes with a ridge in between.
    mask = torch.ones(40, 41, dtype=torch.bool)
    mask[:, 20] = False
    left, right = torch.tensor([[0.5, 0.1, -1.0], [-0.5, 0.3, -1.0]], dtype=torch.float64)
    raster = torch.where((torch.arange(41) < 20)[None, :, None], left, right).expand(40, 41, 3)
    found = curls(raster[mask].mT, torch.ones(1600, dtype=torch.float64), mask)
    assert found.across.abs().max() == 0


X = torch.linspace(-1, 1, 40, dtype=torch.float64).expand(40, 40)


@pytest.mark.parametrize(
    ("slope", "side", "needed"),
    [
        (0 * X, 40, "more than one matrix"),  # a plane
        (0.5 * X + 0.3 * X**2, 40, "more than one matrix"),  # a cylinder
        (X, 3, "Widen the mask"),
    ],
)
def test_planes_cylinders_and_too_few_pixels_are_rejected(slope, side, needed):
    mask = torch.zeros(40, 40, dtype=torch.bool)
    mask[:side, :side] = True
    normals = torch.stack([slope, 0 * X + 0.2, 0 * X - 1])[:, mask]
    with pytest.raises(InputError, match=needed):
        integrable(normals, torch.ones(side**2, dtype=torch.float64), mask)
