import pytest
import torch
from torch.testing import assert_close

from pimper_torch.errors import InputError
from pimper_torch.single_view.factorization.bas_relief import BasRelief
from pimper_torch.single_view.photometric_stereo.hayakawa import (
    metric_from_albedo,
    metric_from_strength,
    relief_from_albedo,
    relief_from_strength,
)


def tilted(bumpy):
    mu, nu, lam = torch.tensor([0.4, -0.3, 0.35], dtype=torch.float64)
    return BasRelief(mu=mu, nu=nu, lam=lam)


def test_pixels_of_one_albedo_are_measured_alike_and_others_let_go(bumpy, generator):
    mixing = torch.randn(3, 3, generator=generator, dtype=torch.float64)
    odd = torch.rand(bumpy.columns.shape[1], generator=generator) < 0.15
    shading = torch.where(odd, 0.5, 1.0) * bumpy.columns
    weight = torch.ones(len(odd), dtype=torch.float64)
    whole = metric_from_albedo(mixing @ shading, weight) @ mixing
    assert_close(whole.mT @ whole, torch.eye(3, dtype=torch.float64), atol=1e-3, rtol=0)
    weight[odd] = 0
    exact = metric_from_albedo(mixing @ shading, weight) @ mixing
    assert_close(exact.mT @ exact, torch.eye(3, dtype=torch.float64))


def test_point_lights_of_one_strength_are_measured_alike(point_lights, generator):
    mixing = torch.randn(3, 3, generator=generator, dtype=torch.float64)
    lights = torch.cat(
        [point_lights(9), torch.zeros(1, 3, dtype=torch.float64)]
    )  # one photograph empty
    whole = metric_from_strength(lights @ torch.linalg.inv(mixing)) @ mixing
    assert_close(whole.mT @ whole, torch.eye(3, dtype=torch.float64))


@pytest.mark.parametrize("shrunk", [0.05, 1.0, 20.0])
def test_a_relief_is_undone_by_pixels_of_one_albedo(bumpy, generator, shrunk):
    odd = torch.rand(bumpy.columns.shape[1], generator=generator) < 0.3
    shading = shrunk * tilted(bumpy).on_shading(torch.where(odd, 0.4, 1.0) * bumpy.columns)
    weight = torch.ones(len(odd), dtype=torch.float64)
    found = relief_from_albedo(shading, weight, bumpy.mask)
    assert_close(found.after(tilted(bumpy)).matrix, torch.eye(3).double(), atol=1e-3, rtol=0)


@pytest.mark.parametrize("shrunk", [0.05, 1.0, 20.0])
def test_a_relief_is_undone_by_point_lights_of_one_strength(bumpy, point_lights, shrunk):
    lights = point_lights(12)
    lights[3] *= 1.4  # an outlier
    shading = tilted(bumpy).on_shading(bumpy.columns)
    weight = torch.ones(shading.shape[1], dtype=torch.float64)
    moved = shrunk * tilted(bumpy).on_lights(lights)
    found = relief_from_strength(moved, shading, weight, bumpy.mask)
    assert_close(found.after(tilted(bumpy)).matrix, torch.eye(3).double(), atol=2e-3, rtol=0)


def test_too_few_are_refused(bumpy, point_lights):
    weight = torch.zeros(bumpy.columns.shape[1], dtype=torch.float64)
    weight[:5] = 1
    with pytest.raises(InputError, match="5 are given; needed: six"):
        metric_from_albedo(bumpy.columns, weight)
    with pytest.raises(InputError, match="5 are given; needed: six"):
        metric_from_strength(point_lights(5))
    weight[3:] = 0
    with pytest.raises(InputError, match="3 are given; needed: four"):
        relief_from_albedo(bumpy.columns, weight, bumpy.mask)
    with pytest.raises(InputError, match="3 are given; needed: four"):
        relief_from_strength(point_lights(3), bumpy.columns, weight, bumpy.mask)


def test_point_lights_on_one_cone_are_refused():
    rotation = torch.linspace(0, 6, 12, dtype=torch.float64)
    ring = torch.stack([rotation.cos(), rotation.sin(), -torch.ones_like(rotation)], dim=1)
    with pytest.raises(InputError, match="on one cone"):
        metric_from_strength(ring)


def test_what_no_measure_makes_equal_is_refused(generator):
    # On a hyperboloid x^2 + y^2 - z^2 = 1.
    rotation, height = torch.rand(2, 40, generator=generator, dtype=torch.float64)
    size = (1 + (3 * height) ** 2).sqrt()
    points = torch.stack([size * (9 * rotation).cos(), size * (9 * rotation).sin(), 3 * height])
    with pytest.raises(InputError, match="not positive"):
        metric_from_albedo(points, torch.ones(40, dtype=torch.float64))
