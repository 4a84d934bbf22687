import pytest
import torch
from scenes import from_above, tilted_square
from torch.testing import assert_close

from pimper_torch.radiometry.base_color import albedo_scale
from pimper_torch.records import Mesh
from pimper_torch.viz.maps import normal_colors, view_maps


@pytest.fixture
def plane():
    """A tilted plane: x from -1 to 1 to the right, y up, farther away on the right."""
    return tilted_square(x=-0.3)


@pytest.fixture
def front():
    return from_above(20.0, 16, 12)


def test_depth_and_normals_of_a_plane_equal_the_formula(plane, front):
    maps = view_maps(plane, front, 0)
    # z = -0.3 x in the world; in the camera the plane is z = 5 + 0.3 x.
    u = torch.arange(16) + 0.5
    slope = (u - 8) / 20
    wanted = (5 / (1 - 0.3 * slope)).expand(12, 16)
    assert maps.seen[5:7, 5:11].all()
    assert_close(maps.depth[maps.seen], wanted[maps.seen])
    assert maps.depth[~maps.seen].isnan().all()
    normal = torch.tensor([0.3, 0, -1]) / 1.09**0.5
    assert_close(maps.normals_cam[maps.seen], normal.expand(int(maps.seen.sum()), 3))
    assert (maps.normals_cam[~maps.seen] == 0).all()


def test_maps_have_the_attributes_of_the_mesh(plane, front):
    transferred = torch.nn.functional.normalize(torch.tensor([0.0, 0.6, 0.8]), dim=0).expand(4, 3)
    height = plane.vertices_world[:, 1:2]
    mesh = plane.replace(normals_world=transferred, albedo=height, confidence=height[:, 0])
    maps = view_maps(mesh, front, 0)
    assert_close(maps.normals_cam[6, 8], torch.tensor([0.0, -0.6, -0.8]))
    assert maps.albedo.shape == (12, 16, 1)
    v = torch.arange(12) + 0.5
    wanted = maps.depth * ((6 - v) / 20)[:, None]
    assert_close(maps.albedo[maps.seen][:, 0], wanted[maps.seen])
    assert_close(maps.confidence[maps.seen], wanted[maps.seen])


def test_colours_of_normals_follow_the_convention():
    normals = torch.tensor([[1.0, 0, 0], [0, -1, 0], [0, 0, -1], [0, 0, 0]])
    wanted = torch.tensor([[1.0, 0.5, 0.5], [0.5, 1, 0.5], [0.5, 0.5, 1], [0, 0, 0]])
    assert_close(normal_colors(normals), wanted)


def test_the_scale_of_albedo_ignores_highlights_and_unknown_albedo(plane):
    albedo = torch.full((1000, 3), 2.0)
    albedo[:5] = 1000.0
    albedo[5:500] = 0.0
    many = Mesh(vertices_world=torch.zeros(1000, 3), faces=plane.faces, albedo=albedo)
    assert albedo_scale(many) == pytest.approx(0.45)
    unsure = many.replace(albedo=20 * albedo, confidence=torch.full((1000,), 0.5))
    assert albedo_scale(unsure) == pytest.approx(0.045 / 2)  # as without confidence
    albedo[100:200] = 20.0
    confidence = torch.ones(1000)
    confidence[100:200] = 0.1
    assert albedo_scale(many.replace(albedo=albedo, confidence=confidence)) == pytest.approx(0.45)
    assert albedo_scale(plane) == 1.0
    assert albedo_scale(plane.replace(albedo=torch.zeros(4, 3))) == 1.0
