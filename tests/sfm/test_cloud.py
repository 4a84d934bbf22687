"""A cloud given with cameras, on a known ball."""

import pytest
import torch

from pimper_torch.records import Views
from pimper_torch.records.sparse_model import SparseModel
from pimper_torch.runtime.errors import PimperWarning
from pimper_torch.stages.sfm.cloud import cloud_tracks, visible_from
from pimper_torch.stages.sfm.colmap import observation_errors
from pimper_torch.stages.sfm.reconstruct_config import ReconstructConfig
from pimper_torch.stages.sfm.triangulation import triangulate
from tests.sfm.ball import cameras_on_an_arc, model_of, photographs


@pytest.fixture(scope="module")
def views() -> Views:
    return photographs(cameras_on_an_arc(), lit=False)


def sphere(count: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(71)
    points = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    return points / points.norm(dim=1, keepdim=True)


@pytest.fixture
def bare(generator) -> SparseModel:
    return model_of(cameras_on_an_arc(), torch.zeros(0, 3).double(), generator, 0.0)


def test_points_of_a_ball_are_visible_on_the_side_of_the_viewer():
    points, center = sphere(2000), torch.tensor([1.0, -2.0, 4.5], dtype=torch.float64)
    facing = points @ center  # more than 1 where the tangent plane is in front of the viewer
    seen = visible_from(points, center)
    assert bool(seen[facing > 1.3].all())
    assert not bool(seen[facing < 0.5].any())  # behind the rim by a spacing of the points


def test_points_on_a_plane_are_all_visible():
    plane = torch.cartesian_prod(*[torch.linspace(-1, 1, 9).double()] * 2)
    points = torch.cat([plane, torch.zeros(81, 1).double()], dim=1)
    assert bool(visible_from(points, torch.tensor([0.3, 0.2, 5.0]).double()).all())


@pytest.mark.parametrize("count", [1, 3, 40])
def test_of_points_at_one_place_some_are_in_sight(count):
    seen = visible_from(torch.ones(count, 3).double(), torch.tensor([0.0, 0, 5]).double())
    assert bool(seen.any())


def test_a_cloud_without_photographic_support_is_dropped(views, bare):
    dark = views.replace(images=0.01 * torch.ones_like(views.images))
    with pytest.warns(PimperWarning, match="0 could be triangulated"):
        found = triangulate(
            dark, bare.replace(points_world=sphere(50)), ReconstructConfig(threads=1), "The file"
        )
    assert len(found.points_world) == 0
    assert torch.equal(found.cam_from_world, bare.cam_from_world)


def test_points_are_observed_where_the_photographs_show_them(views, bare):
    found = cloud_tracks(views, bare.replace(points_world=sphere(1500)))
    assert torch.equal(found.cam_from_world, bare.cam_from_world)
    assert len(found.points_world) > 150
    assert float(found.points_world[:, 2].max()) < 0  # the side of the cameras
    errors = observation_errors(found)
    assert float(errors.median()) < 0.1
    assert bool((torch.bincount(found.observation_point) >= 3).all())


@pytest.mark.parametrize(
    "wrong", [lambda points: 1.1 * points, lambda points: points + torch.tensor([0.0, 0, -0.2])]
)
def test_points_in_a_different_frame_are_hardly_observed(views, bare, wrong):
    right = cloud_tracks(views, bare.replace(points_world=sphere(1500)))
    found = cloud_tracks(views, bare.replace(points_world=wrong(sphere(1500))))
    assert len(found.points_world) < 0.05 * len(right.points_world)


def test_cameras_with_a_cloud_get_more_points_on_the_surface(views, bare):
    settings = ReconstructConfig(threads=1)
    with pytest.warns(PimperWarning, match=r"were triangulated from the photographs"):
        without = triangulate(views, bare, settings, "The file")
    with pytest.warns(PimperWarning, match=r"held fixed, [0-9,]+ of them found from the cloud"):
        found = triangulate(views, bare.replace(points_world=sphere(1500)), settings, "The file")
    assert torch.equal(found.cam_from_world, bare.cam_from_world)
    assert len(found.points_world) > len(without.points_world) + 100
    off = (found.points_world.norm(dim=1) - 1).abs()
    assert float(off.median()) < 0.001
    assert float(off.quantile(0.95)) < 0.01
