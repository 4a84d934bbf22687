"""Undefined measurements are refused with a message."""

import pytest
import torch
from scenes import ball

from pimper_bench.metrics import (
    EvaluateConfig,
    TrueSurface,
    align_estimate,
    compare_along_rays,
    dtu_figures,
    sample_surface,
)
from pimper_bench.metrics.dtu_protocol import supersample
from pimper_bench.metrics.estimates import Estimate
from pimper_bench.truth import DtuProtocol, Truth
from pimper_torch.records import Mesh
from pimper_torch.runtime.errors import ConfigError, InputError

FLAT = Mesh(vertices_world=torch.ones(3, 3), faces=torch.tensor([[0, 1, 2]]))
LARGE = 1e5 * torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype=torch.float64)
PROTOCOL = DtuProtocol(
    obs_mask=torch.ones(9, 9, 9) > 0,
    bounding_box=torch.tensor([[0.0, 0, 0], [8, 8, 8]]).double(),
    resolution=1.0,
    plane=torch.tensor([0.0, 0, 1, 0]).double(),
)


def _table_alone(make):
    table = make.square(height=-1.0, side=20.0)
    table = table.replace(vertices_world=table.vertices_world - torch.tensor([10.0, 10.0, 0.0]))
    truth = Truth(mesh=ball(), surroundings=table)
    return compare_along_rays(table, make.capture(truth, cameras=make.cameras(count=1)), 0)


def _elsewhere(make):
    away = ball(center=(0.0, 100.0, 0.0))
    return compare_along_rays(away, make.capture_of(ball(), cameras=make.cameras(count=1)), 0)


def _aligned(make, capture, method):
    generator = torch.Generator().manual_seed(1)
    return align_estimate(Estimate(mesh=make.square()), capture, method, generator=generator)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda make: TrueSurface(make.capture(Truth())), "neither a mesh nor points"),
        (lambda make: _aligned(make, make.capture(Truth()), "icp"), "neither a mesh nor points"),
        (lambda make: sample_surface(FLAT, 10, torch.Generator()), "degenerate"),
        (_table_alone, "on the surroundings"),
        (_elsewhere, "Check the frame"),
        (
            lambda make: dtu_figures(ball(), LARGE + 1e3, PROTOCOL, torch.Generator()),
            "frame and the millimetres",
        ),
        (
            lambda make: supersample(FLAT.replace(vertices_world=LARGE), 0.2),
            "millimetres of the set",
        ),
    ],
)
def test_undefined_measurements_are_refused(make, call, message):
    with pytest.raises(InputError, match=message):
        call(make)


def test_a_zero_threshold_is_refused():
    with pytest.raises(ConfigError, match="thresholds_percent"):
        EvaluateConfig(thresholds_percent=(0.5, 0.0))
