"""Several photographs of one pose: one image for structure from motion, one camera for all."""

import pytest
import torch
from sparse_models import views_of
from torch.testing import assert_close

from pimper_bench.scenes.scene_cameras import arc_cameras
from pimper_torch.records import CameraModel, SilhouettePrior
from pimper_torch.records.sparse_model import SparseModel
from pimper_torch.runtime.errors import InputError
from pimper_torch.stages.sfm.poses import (
    equal_poses,
    expand_to_photographs,
    mean_images,
    one_view_per_pose,
    with_poses,
)

POSES = (0, 1, 0, 2, 1, 0)


@pytest.fixture
def views():
    generator = torch.Generator().manual_seed(5)
    return views_of(
        torch.rand(6, 3, 8, 12, generator=generator),
        names=tuple("abcdef"),
        masks=torch.rand(6, 8, 12, generator=generator) > 0.5,
        focals_px=torch.tensor([100.0, torch.nan, 102.0, 90.0, torch.nan, torch.nan]),
        poses=torch.tensor(POSES),
    )


def test_structure_from_motion_gets_the_mean_radiance_of_a_pose(views):
    few = mean_images(views)
    assert few.names == ("a", "b", "d")
    assert few.poses is None
    assert_close(few.images[0], views.images[[0, 2, 5]].mean(dim=0))
    assert torch.equal(few.masks[1], views.masks[1] | views.masks[4])
    assert_close(few.focals_px, torch.tensor([100.0, torch.nan, 90.0]), equal_nan=True)
    plain = views.replace(poses=None)
    assert mean_images(plain) is plain


def test_photographs_of_different_sizes_do_not_share_a_pose(views):
    sizes = views.sizes_px.clone()
    sizes[4, 0] = 10
    with pytest.raises(
        InputError, match="of the poses of b have different sizes; needed: one size"
    ):
        mean_images(views.replace(sizes_px=sizes))


def test_photographs_of_a_pose_share_its_camera_and_observations(views):
    lens = CameraModel(camera=1, model="PINHOLE", params=(90.0, 90.0, 6.0, 4.0), width=12, height=8)
    model = SparseModel(
        names=("d", "a"),  # pose 1 is not registered
        lenses=(lens, lens.replace(camera=2)),
        cam_from_world=torch.eye(4).double() * torch.tensor([3.0, 1.0])[:, None, None],
        points_world=torch.zeros(2, 3).double(),
        observation_point=torch.tensor([0, 0, 1]),
        observation_view=torch.tensor([0, 1, 1]),
        observation_pixels=torch.tensor([[1.0, 1], [2, 2], [3, 3]]).double(),
        sessions=torch.tensor([7, 8]),
    )
    every = expand_to_photographs(model, views)
    assert every.names == ("a", "c", "d", "f")
    assert every.cam_from_world[:, 0, 0].tolist() == [1, 1, 3, 1]
    assert [one.camera for one in every.lenses] == [2, 2, 1, 2]
    assert every.sessions.tolist() == [8, 8, 7, 8]
    assert every.observation_point.tolist() == [0, 0, 0, 0, 1, 1, 1]
    assert every.observation_view.tolist() == [0, 1, 2, 3, 0, 1, 3]
    assert every.observation_pixels[:, 0].tolist() == [2, 2, 1, 2, 3, 3, 3]
    assert expand_to_photographs(model, views.replace(poses=None)) is model


def test_equal_cameras_share_a_pose_and_neighbours_do_not():
    cameras = arc_cameras(40, width=60, height=40, focal_px=90.0, distance=3.0, span_deg=60.0)
    assert equal_poses(cameras).tolist() == list(range(40))
    order = torch.tensor([0, 7, 0, 7, 7, 39])
    again = cameras.take(order)
    noise = 1e-3 * torch.randn(6, 3, generator=torch.Generator().manual_seed(1)).double()
    poses = again.cam_from_world.clone()
    poses[:, :3, 3] += noise  # a tenth of a pixel
    assert equal_poses(again.replace(cam_from_world=poses)).tolist() == [0, 1, 0, 1, 1, 5]


def test_one_photograph_of_a_pose_has_the_observations_of_all(reconstruction):
    scene = reconstruction.scene
    copies = torch.tensor([0, 1, 2, 1])
    views = scene.views.take(copies).replace(names=("a.png", "b.png", "c.png", "d.png"))
    fourth = scene.observation_view == 1  # points of the second, now seen only by its duplicate
    views = views.replace(images=views.images * torch.tensor([1, 0.1, 1, 1])[:, None, None, None])
    four = scene.replace(
        views=views,
        cameras=scene.cameras.take(copies),
        lenses=scene.lenses + scene.lenses[:1],
        observation_view=torch.where(fourth, 3, scene.observation_view),
    )
    assert with_poses(scene) is scene
    posed = with_poses(four)
    assert posed.views.poses.tolist() == [0, 1, 2, 1]
    few = one_view_per_pose(posed)
    assert few.chosen.tolist() == [0, 2, 3]  # the darker one has less texture
    assert few.of.tolist() == [0, 2, 1, 2]
    assert few.scene.views.names == ("a.png", "c.png", "d.png")
    assert few.scene.unregistered == scene.unregistered
    assert torch.equal(few.scene.observed, scene.observed[:, [0, 2, 1]])
    named = one_view_per_pose(posed, ("b",))
    assert named.scene.views.names == ("a.png", "b.png", "c.png")
    assert torch.equal(named.scene.observed, scene.observed)
    order = torch.argsort(3 * scene.observation_point + scene.observation_view)
    assert_close(named.scene.observation_pixels, scene.observation_pixels[order])
    assert one_view_per_pose(scene).scene is scene


def test_the_kept_photograph_of_a_pose_has_the_silhouette_of_any(reconstruction):
    scene = reconstruction.scene
    copies = torch.tensor([0, 1, 2, 1, 1])
    names = ("a.png", "b.png", "c.png", "d.png", "e.png")
    views = scene.views.take(copies).replace(names=names, poses=copies)
    prior = SilhouettePrior(
        names=("e.png", "c.png", "b.png", "gone.png"),
        sizes_px=torch.tensor([[3, 2]] * 4),
        inside=torch.arange(4.0)[:, None, None].expand(4, 2, 3) / 4,
    )
    five = scene.replace(
        views=views.replace(priors=(prior,)),
        cameras=scene.cameras.take(copies),
        lenses=scene.lenses + scene.lenses[:2],
    )

    def kept(*needed):
        (found,) = one_view_per_pose(five, needed).scene.views.priors
        return dict(zip(found.names, (4 * found.inside[:, 0, 0]).int().tolist(), strict=True))

    assert kept("d") == {"d.png": 0, "c.png": 1}  # that of the first photograph with one
    assert kept("b") == {"b.png": 2, "c.png": 1}  # its own
