import pytest
import torch
from torch.nn.functional import normalize
from torch.testing import assert_close

from pimper_torch.errors import ReconstructionError
from pimper_torch.evidence.baselines.anchoring import (
    bas_relief_through,
    points_on,
    rotation_normals,
)
from pimper_torch.evidence.baselines.template import lay_template


@pytest.fixture
def points():
    return torch.randn(60, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)


def test_points_undo_a_bas_height_field_transformation_even_inverted(points):
    for scale in (2.5, -0.4):
        wanted = torch.tensor([0.3, -0.2, scale, 4.0], dtype=torch.float64)
        x, y, z = points.unbind(dim=1)
        relief = (z - 0.3 * x + 0.2 * y - 4.0) / scale
        assert_close(bas_relief_through(points, relief), wanted, atol=1e-2, rtol=0)  # the ridge


def test_wrong_points_have_no_say(points):
    x, z = points[:, 0], points[:, 2]
    moved = points.clone()
    moved[:12, 2] += 40
    found = bas_relief_through(moved, z - 0.5 * x)
    assert_close(found, torch.tensor([0.5, 0, 1, 0], dtype=torch.float64), atol=0.02, rtol=0)


def test_a_flat_height_field_keeps_its_scale(points):
    x, y, _ = points.unbind(dim=1)
    flat = 0.2 * x
    level = torch.stack([x, y, 0.2 * x + 1], dim=1)
    found = bas_relief_through(level, flat)
    assert found.isfinite().all()
    rebuilt = found[0] * x + found[1] * y + found[2] * flat + found[3]
    assert_close(rebuilt, level[:, 2], atol=1e-3, rtol=0)
    assert found[2] > 0


def test_normals_follow_the_height_field(points):
    slopes = points[:, :2]
    normals = normalize(torch.cat([slopes, -torch.ones(60, 1).double()], dim=1), dim=1)
    rotated = rotation_normals(torch.tensor([0.3, -0.1, 2.0, 7.0], dtype=torch.float64), normals)
    assert_close(-rotated[:, 0] / rotated[:, 2], 2 * slopes[:, 0] + 0.3)
    assert_close(-rotated[:, 1] / rotated[:, 2], 2 * slopes[:, 1] - 0.1)


def test_points_beside_the_mesh_or_far_from_it_are_left_out(photographed, sphere):
    _, scene, coarse = photographed(sphere)
    template = lay_template(coarse.mesh, scene.cameras, coarse.reference, 1.0)
    kept = points_on(template, scene.points_world, coarse)
    assert 50 < len(kept) <= len(scene.points_world)
    away = scene.points_world - 0.5 * scene.points_world  # half way to the centre
    with pytest.raises(ReconstructionError, match="at least 4"):
        points_on(template, away, coarse)
    both = points_on(template, torch.cat([scene.points_world, away]), coarse)
    assert_close(both, kept)
