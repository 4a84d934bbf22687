from functools import partial

import pytest
import torch
from scenes import ball as mesh_of_ball

from pimper_torch.stages.silhouettes.explain import Explain
from pimper_torch.stages.silhouettes.trace import TraceContours
from tests.silhouettes.shapes import ball, silhouettes_of

explain = Explain()


@pytest.fixture(scope="module")
def contours(cameras):
    return TraceContours()(silhouettes_of(ball, cameras), cameras)


sphere = partial(mesh_of_ball, level=4)


def test_the_true_surface_explains_its_silhouettes(contours):
    found = explain(sphere(), contours)
    assert found.uncovered.max() < 0.02
    assert found.outside.max() < 0.02


def test_a_hole_is_not_covered_by_the_back_face_behind_it(contours, cameras):
    whole = sphere()
    up = whole.vertices_world[whole.faces].mean(dim=1)[:, 2]
    found = explain(whole.replace(faces=whole.faces[up < 0.6]), contours)
    above = cameras.centers_world[:, 2].argmax()
    assert found.uncovered[above] == found.uncovered.max()
    assert found.uncovered.max() > 0.1
    assert found.outside.max() < 0.02


def test_surface_outside_silhouettes_is_counted(contours):
    """A radius larger by a tenth adds 0.21 of the area, and more by perspective."""
    found = explain(sphere(1.1), contours)
    assert 0.19 < found.outside.min() < found.outside.max() < 0.27
    assert found.uncovered.max() < 0.01


def test_uncertain_silhouettes_and_unreliable_views_count_less(contours):
    silhouettes = contours.silhouettes
    unsure = torch.where(silhouettes.inside < 0.5, 0.25, silhouettes.inside)
    reliable = silhouettes.reliable.clone()
    reliable[3:] = False
    known = explain(sphere(1.1), contours).outside
    some = silhouettes.replace(inside=unsure, reliable=reliable)
    found = explain(sphere(1.1), contours.replace(silhouettes=some)).outside
    assert len(found) == 3
    assert torch.allclose(found, known[:3] / 2, rtol=0.05)
