import math

import pytest
import torch

from pimper_bench.metrics import TrueSurface
from pimper_bench.truth import Truth


def compared(mesh, capture, *, samples=8_000, seen_from=3, **more):
    return TrueSurface(capture, seen_from=seen_from, samples=samples).compare(mesh, **more)


def test_a_raised_square_is_off_by_its_height_both_ways(make):
    found = compared(
        make.square(height=0.1),
        make.capture_of(make.square()),
        thresholds_percent=(99 * 0.1 / 2**0.5, 101 * 0.1 / 2**0.5),
    )
    assert found.diagonal == pytest.approx(2**0.5)
    assert found.accuracy.mean == pytest.approx(0.1)
    assert found.accuracy.median == pytest.approx(0.1)
    assert found.accuracy.mean_percent == pytest.approx(10 / 2**0.5)
    assert found.whole.completeness.mean == pytest.approx(0.1)
    assert found.whole.chamfer_mean == pytest.approx(0.1)
    assert found.whole.chamfer_sum == pytest.approx(0.2)
    assert found.whole.chamfer_mean_percent == pytest.approx(10 / 2**0.5)
    assert found.whole.chamfer_sum_percent == pytest.approx(20 / 2**0.5)
    below, above = found.whole.thresholds
    assert (below.precision, below.recall, below.f_score) == (0, 0, 0)
    assert (above.precision, above.recall, above.f_score) == (1, 1, 1)
    assert above.threshold == pytest.approx(0.101)
    assert found.seen is None
    assert found.seen_fraction is None


def test_a_larger_square_is_inaccurate_and_complete(make):
    found = compared(make.square(side=2.0), make.capture_of(make.square()))
    assert found.whole.completeness.mean < 1e-12
    # Outside the unit square: two strips, 1/2 off on average, and a corner whose mean
    # distance to its vertex is (sqrt 2 + asinh 1) / 3.
    expected = (1 * 0.5 + 1 * 0.5 + (2**0.5 + math.asinh(1)) / 3) / 4
    assert found.accuracy.mean == pytest.approx(expected, rel=0.02)  # 8000 samples
    # Its largest threshold is 1 % of sqrt 2, around a square of 1 in 4.
    at = found.whole.thresholds[-1]
    assert at.precision == pytest.approx((1 + 2 * at.threshold) / 4, abs=0.01)
    assert at.recall == 1
    harmonic = 2 * at.precision / (1 + at.precision)
    assert at.f_score == pytest.approx(harmonic)


def test_half_a_sphere_is_accurate_and_half_complete(make):
    found = compared(make.half_sphere(), make.capture_of(make.sphere()))
    assert found.accuracy.mean < 1e-12
    # A missing point at polar angle t below the rim is 2 sin(t / 2) from it; area is cos t dt.
    t = (torch.arange(10_000).double() + 0.5) / 10_000 * math.pi / 2
    missing = (2 * (t / 2).sin() * t.cos()).mean() * math.pi / 2
    # The rim runs along facets, a facet's size up and down.
    assert found.whole.completeness.mean == pytest.approx(float(missing) / 2, rel=0.03)
    at = found.whole.thresholds[-1]
    assert at.precision == 1
    rim = math.sin(2 * math.asin(at.threshold / 2)) / 2  # fraction of the sphere below the rim
    assert at.recall == pytest.approx(0.5 + rim, abs=0.01)


def test_points_on_the_table_are_excluded_from_accuracy_and_reported(make):
    table = make.square(side=3.0)
    table = table.replace(vertices_world=table.vertices_world - 1.0)  # at z = -1
    truth = Truth(mesh=make.square(), surroundings=table)
    estimate = make.square(height=-0.9)  # 0.1 over the table, 0.9 under the object
    both = make.square(height=0.1)
    joined = estimate.replace(
        vertices_world=torch.cat([estimate.vertices_world, both.vertices_world]),
        faces=torch.cat([estimate.faces, both.faces + 4]),
    )
    found = compared(joined, make.capture(truth))
    assert found.surroundings_fraction == pytest.approx(0.5, abs=5e-3)
    assert found.accuracy.mean == pytest.approx(0.1)
    assert found.accuracy.samples == pytest.approx(4_000, abs=20)
    only = compared(estimate, make.capture(truth))
    assert only.accuracy is None
    assert only.whole is None
    assert only.surroundings_fraction == 1


def test_completeness_of_the_visible_part_ignores_the_back(make):
    cameras = make.cameras(count=5, span_deg=1.0)
    front = make.sphere(level=4)
    towards = cameras.centers_world.mean(dim=0)
    facing = (front.vertices_world[front.faces].mean(dim=1) @ towards) > 0
    half = front.replace(faces=front.faces[facing])
    found = compared(half, make.capture_of(front, cameras=cameras))
    assert found.whole.completeness.mean > 0.1
    assert found.seen.completeness.mean < 1e-3
    # From distance 5 a sphere of radius 1 shows the cap above 1 / 5: (1 - 1 / 5) / 2.
    assert found.seen_fraction == pytest.approx(0.4, abs=0.01)


def test_views_from_one_position_count_once(make):
    cameras = make.cameras(count=4, span_deg=1.0)
    sphere = make.sphere(level=3)
    apart = make.capture_of(sphere, cameras=cameras)
    same = make.capture_of(sphere, cameras=cameras, position=torch.tensor([0, 0, 1, 1]))
    assert compared(sphere, apart, seen_from=3).seen_fraction > 0.3
    assert compared(sphere, same, seen_from=3).seen_fraction == 0
    assert compared(sphere, same, seen_from=2).seen_fraction > 0.3


def test_an_occluder_hides_the_surface(make):
    cameras = make.cameras(count=3, span_deg=1.0)
    sphere = make.sphere(level=3)
    shade = make.square(side=8.0)
    centre = 0.5 * cameras.centers_world.mean(dim=0)
    shade = shade.replace(
        vertices_world=shade.vertices_world
        - shade.vertices_world.new_tensor([4.0, 4.0, 0.0])
        + centre
    )
    hidden = make.capture(Truth(mesh=sphere, surroundings=shade), cameras=cameras)
    assert compared(sphere, hidden).seen_fraction == 0


def test_clouds_can_replace_either_surface(make):
    points = make.square().replace(faces=torch.zeros(0, 3, dtype=torch.long))
    raised = make.square(height=0.1).replace(faces=points.faces)
    truth = Truth(points_world=points.vertices_world)
    found = compared(raised, make.capture(truth))
    assert found.accuracy.mean == pytest.approx(0.1)
    assert found.accuracy.samples == 4
    assert found.whole.chamfer_sum == pytest.approx(0.2)


def test_estimates_are_measured_equally_in_any_order(make):
    truth = TrueSurface(make.capture_of(make.sphere()), samples=500)
    first = truth.compare(make.sphere(1.1))
    truth.compare(make.sphere(1.2))
    assert truth.compare(make.sphere(1.1)) == first
