import warnings

import pytest
import torch

from pimper_bench.metrics.other_poses import warn_of_other_poses
from pimper_bench.truth import Truth
from pimper_torch.geometry.rigid import rigid
from pimper_torch.runtime.errors import PimperWarning


@pytest.fixture
def figure(make):
    """An ellipsoid with bumps on its three axes, which differs from its mirror images."""
    ball = make.sphere(level=3)
    v = ball.vertices_world
    out = 1 + (v.clamp_min(0) * torch.tensor([0.3, 0.5, 0.7]).double()).square().sum(dim=1)
    return ball.replace(vertices_world=out[:, None] * v * torch.tensor([1, 0.8, 0.6]).double())


def warned(make, mesh, truth):
    with pytest.warns(PimperWarning, match="hardly meets the truth") as caught:
        warn_of_other_poses(mesh, make.capture(Truth(mesh=truth)), 3)
    return str(caught[0].message)


def moved(make, mesh, linear):
    return make.moved(mesh, rigid(linear, torch.zeros(3).double()))


def test_a_turned_result_is_named_with_the_score_that_the_rotation_gives(make, generator, figure):
    rotation = make.rotation(generator)
    said = warned(make, moved(make, figure, rotation), figure)
    assert "1.00 after the best rotation" in said
    angle = torch.rad2deg(torch.arccos((rotation.trace() - 1) / 2))
    assert f"in a different frame: turned by {float(angle):.0f} degrees, and 1 times" in said


def test_a_larger_result_is_named_with_its_size(make, figure):
    said = warned(make, moved(make, figure, 1.15 * torch.eye(3).double()), figure)
    assert "turned by 0 degrees, and 1.15 times as large" in said


def test_a_mirrored_result_is_named_also_if_it_is_turned(make, generator, figure):
    said = warned(make, moved(make, figure, -make.rotation(generator)), figure)
    assert "1.00 after the best reflection. It is a mirror image" in said


def test_a_different_object_fits_in_no_pose(make, figure):
    thin = make.sphere(level=3)
    thin = thin.replace(vertices_world=thin.vertices_world * torch.tensor([1, 0.2, 0.2]).double())
    assert "It may be a different object" in warned(make, thin, figure)


def test_a_result_that_meets_the_truth_gives_no_warning(make, generator, figure):
    noise = 0.01 * torch.randn(figure.vertices_world.shape, generator=generator).double()
    rough = figure.replace(vertices_world=figure.vertices_world + noise)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_other_poses(rough, make.capture(Truth(mesh=figure)), 3)
