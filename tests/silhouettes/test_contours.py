import math
from functools import partial

import pytest
import torch

from pimper_torch.geometry.visual_hull import bounding_cube
from pimper_torch.runtime.errors import PimperWarning
from pimper_torch.stages.silhouettes import trace
from pimper_torch.stages.silhouettes.trace import TraceContours
from tests.silhouettes.shapes import ball, silhouettes_of, two_balls


@pytest.fixture(autouse=True)
def coarse_voxels(monkeypatch):
    """Build hulls with voxels of 0.04, two thirds of a pixel; default ones take a second each."""
    few = partial(trace.visual_hull, num_voxels=300_000)
    monkeypatch.setattr(trace, "visual_hull", few)


@pytest.mark.parametrize("shape", [ball, two_balls])
def test_the_box_of_silhouettes_is_tight(cameras, shape):
    low, high = bounding_cube(silhouettes_of(shape, cameras), cameras)
    assert (low < -1.1).all()
    assert (high > 1.1).all()
    assert (high - low).max() < 2 * 2.4


def test_two_wrong_estimated_silhouettes_of_twenty_remove_no_volume(cameras):
    silhouettes = silhouettes_of(ball, cameras)
    wrong = silhouettes.inside.clone()
    wrong[[3, 15], :, 60:] = 0

    def volume(inside, source):
        hull = TraceContours()(silhouettes.replace(inside=inside, source=source), cameras).hull
        return float(hull.occupied.sum() * hull.spacing**3)

    true = 4 / 3 * math.pi
    assert true < volume(silhouettes.inside, "found") < 1.1 * true
    assert true < volume(wrong, "found")
    assert volume(wrong, "masks") < 0.9 * true  # given masks are trusted


def test_silhouettes_that_contain_everything_do_not_constrain(cameras):
    silhouettes = silhouettes_of(ball, cameras).replace(source="everything")
    contours = TraceContours()(silhouettes, cameras)
    assert not contours.confine
    far = torch.tensor([[1e6, 0.0, 0.0]], dtype=torch.float64)
    assert contours.hull.holds(far).all()
    assert len(contours.touching(far, far).points_world) == 0


def test_the_half_space_above_a_plane_is_the_hull(cameras):
    plane = torch.tensor([0.0, 0.0, 1.0, -0.25]).double()
    silhouettes = silhouettes_of(ball, cameras).replace(
        source="everything", planes_world=plane[None]
    )
    contours = TraceContours()(silhouettes, cameras)
    assert not contours.confine
    points = torch.tensor([[5.0, -3, 0.3], [5.0, -3, 0.2], [0.0, 0, 1e6]]).double()
    assert contours.hull.holds(points, 1.0).tolist() == [True, False, True]
    both = torch.stack([plane, torch.tensor([0.0, 0.0, -1.0, 10.0]).double()])
    between = TraceContours()(silhouettes.replace(planes_world=both), cameras)
    assert between.hull.holds(points, 1.0).tolist() == [True, False, False]
    assert (contours.hull.depth_of(points) > 0).all()


def test_silhouettes_without_common_volume_warn(cameras):
    silhouettes = silhouettes_of(ball, cameras)
    nothing = silhouettes.replace(inside=torch.zeros_like(silhouettes.inside))
    with pytest.warns(PimperWarning, match="no point in common"):
        assert not TraceContours()(nothing, cameras).confine
