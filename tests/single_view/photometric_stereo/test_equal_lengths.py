import pytest
import torch
from torch.testing import assert_close

from pimper_torch.runtime.errors import InputError
from pimper_torch.single_view.factorization.bas_relief import (
    BasRelief,
    relief_from_strength,
)


def tilted(bumpy):
    mu, nu, lam = torch.tensor([0.4, -0.3, 0.35], dtype=torch.float64)
    return BasRelief(mu=mu, nu=nu, lam=lam)


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
    weight = torch.ones(bumpy.columns.shape[1], dtype=torch.float64)
    with pytest.raises(InputError, match="3 are given; needed: four"):
        relief_from_strength(point_lights(3), bumpy.columns, weight, bumpy.mask)
