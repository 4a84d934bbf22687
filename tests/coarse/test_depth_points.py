"""Points from depth maps of a known ball under changing light."""

import pytest
import torch
from torch.nn.functional import avg_pool2d

from pimper_torch.geometry.pixels import scale_intrinsics
from pimper_torch.geometry.rigid import transform
from pimper_torch.io.tensors import scene_of
from pimper_torch.records import SparseScene
from pimper_torch.runtime.errors import PimperWarning
from pimper_torch.stages.coarse.depth_points import DepthPoints
from pimper_torch.stages.sfm.triangulation import FEW_OBSERVED, lacks_points
from tests.sfm.ball import cameras_on_an_arc, photographs


@pytest.fixture(scope="module")
def scene() -> SparseScene:
    cameras = cameras_on_an_arc()
    images = avg_pool2d(photographs(cameras).images.float(), 2)
    K = scale_intrinsics(cameras.intrinsics, 0.5, 0.5)
    return scene_of(images, K, cameras.cam_from_world)


def test_depth_points_on_the_surface_are_added_to_existing_ones(scene):
    own = torch.tensor([[0.0, 0.0, -1.0], [0.1, 0.0, -0.99]])
    given = scene_of(
        scene.views.images, scene.cameras.intrinsics, scene.cameras.cam_from_world, points_world=own
    )
    assert lacks_points(given)
    with pytest.warns(PimperWarning, match="points come from depth maps"):
        found = DepthPoints()(given)
    assert not lacks_points(found, FEW_OBSERVED)
    assert torch.equal(found.points_world[:2], own)
    assert bool(found.observed[:2].all())
    assert found.cameras is given.cameras
    assert bool((found.observed.sum(dim=1) >= 3).all())
    off = (found.points_world.norm(dim=1) - 1).abs()  # a pixel is 0.01 on the ball
    assert float(off.median()) < 0.005
    assert float(off.quantile(0.9)) < 0.03
    ahead = transform(found.cameras.cam_from_world, found.points_world)[..., 2] > 0
    assert bool(ahead.mT[found.observed].all())
    assert 0 < float(found.reprojection_errors_px.median()) < 0.5


def test_depth_points_are_inside_the_masks(scene):
    height, width = scene.views.images.shape[-2:]
    column = torch.arange(width).expand(height, width)
    masks = (column > 0.4 * width).expand(scene.cameras.num_views, -1, -1)
    with pytest.warns(PimperWarning, match="points come"):
        found = DepthPoints()(scene.replace(views=scene.views.replace(masks=masks)))
    assert float(found.observation_pixels[:, 0].min()) > 0.39 * width


def test_cameras_of_other_photographs_give_no_points(scene):
    order = [3, 0, 5, 1, 4, 2]
    cameras = scene.cameras.replace(cam_from_world=scene.cameras.cam_from_world[order])
    wrong = scene.replace(cameras=cameras)
    with pytest.warns(PimperWarning, match="No points: features do not match"):
        assert DepthPoints()(wrong) is wrong
