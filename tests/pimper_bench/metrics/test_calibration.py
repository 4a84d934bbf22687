import math

import pytest
import torch
from torch.testing import assert_close

from pimper_bench.metrics import EvaluateConfig, evaluate, rows
from pimper_bench.metrics.estimates import Estimate
from pimper_bench.metrics.surface_distances import calibrate, sample_surface
from pimper_bench.truth import Truth

COUNT = 40_000


@pytest.fixture
def noise(generator):
    """Gaussian errors with standard deviations over a range of factor 30."""
    deviation = 0.01 * 30 ** torch.rand(COUNT, generator=generator, dtype=torch.float64)
    off = deviation * torch.randn(COUNT, generator=generator, dtype=torch.float64)
    return deviation, off.abs()


def test_gaussian_noise_of_the_expected_deviation_is_calibrated(noise):
    found = calibrate(*noise)
    assert found.ratio == pytest.approx(1, abs=0.03)
    assert found.within_one == pytest.approx(0.683, abs=0.01)
    assert found.within_two == pytest.approx(0.954, abs=0.01)
    assert 0.4 < found.rank_correlation < 0.8  # errors of equal deviation vary in size
    assert len(found.bins) == 10
    for one in found.bins:
        assert one.root_mean_square == pytest.approx(one.expected, rel=0.1)
        assert one.robust == pytest.approx(one.expected, rel=0.1)
    assert found.bins[-1].expected > 20 * found.bins[0].expected


def test_an_overconfident_surface_is_reported(noise):
    deviation, off = noise
    found = calibrate(deviation / 3, off)
    assert found.ratio == pytest.approx(3, rel=0.03)
    assert found.within_two < 0.55
    same = calibrate(torch.full_like(off, 0.1), off)
    assert math.isnan(same.rank_correlation)
    assert max(one.robust for one in same.bins) < 1.3 * min(one.robust for one in same.bins)


def test_outliers_change_only_the_root_mean_square(noise):
    deviation, off = noise
    off[::20] = 100.0
    found = calibrate(deviation, off)
    assert found.ratio == pytest.approx(1, abs=0.1)
    assert found.bins[0].root_mean_square > 10
    assert found.bins[0].robust == pytest.approx(found.bins[0].expected, rel=0.2)


def test_samples_interpolate_vertex_attributes(make, generator):
    sphere = make.sphere(level=2)
    drawn = sample_surface(sphere, 500, generator)
    assert_close(drawn.interpolate(sphere.vertices_world[:, 2]), drawn.points[:, 2])
    cloud = sphere.replace(faces=torch.zeros(0, 3, dtype=torch.long))
    some = sample_surface(cloud, 50, generator)
    assert_close(some.interpolate(sphere.vertices_world[:, 2]), some.points[:, 2])


def test_expected_errors_are_in_the_unit_of_the_truth(make, generator):
    sphere, cameras = make.sphere(level=5), make.cameras()
    deviation = 0.003 * (2 + sphere.vertices_world[:, 2])
    lift = deviation * torch.randn(len(deviation), generator=generator, dtype=torch.float64)
    rough = sphere.vertices_world * (1 + lift[:, None])
    rotation, shift = make.rotation(generator), torch.tensor([3.0, -1.0, 2.0]).double()
    # The estimate and its expected errors are half as large as the truth.
    mesh = sphere.replace(vertices_world=0.5 * rough @ rotation.mT + shift)
    estimate = Estimate(
        mesh=mesh.replace(expected_error=0.5 * deviation),
        names=tuple(f"view_{view}.png" for view in range(5)),
        cameras=make.transferred(cameras, 0.5, rotation, shift),
    )
    capture = make.capture(Truth(mesh=sphere), cameras=cameras)
    found = evaluate(estimate, capture, EvaluateConfig(samples=20_000))
    calibration = found.surface.calibration
    # Interpolation reduces the noise of vertices, by 1 / sqrt 2 in the mean over a face.
    assert calibration.ratio == pytest.approx(2**-0.5, abs=0.12)
    named = {row.name: row for row in dict(rows(found))["surface"]}
    assert named["expected_error"].value.startswith(f"{calibration.ratio:.2f};")
    silent = evaluate(
        estimate.replace(mesh=mesh), capture, EvaluateConfig(samples=2000)
    ).surface.calibration
    assert silent is None


@pytest.mark.parametrize("constant", [0.0, math.inf])
def test_without_expected_errors_there_is_no_calibration(constant):
    assert calibrate(torch.full((20,), constant), torch.ones(20)) is None
