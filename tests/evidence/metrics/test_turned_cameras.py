import pytest
import torch
from torch.testing import assert_close

from pimper_torch.evidence.metrics import similarity_between_cameras
from pimper_torch.evidence.metrics.poses import compare_cameras
from pimper_torch.evidence.metrics.turned_cameras import standing_as
from pimper_torch.evidence.scenes.cameras import arc_cameras
from pimper_torch.geometry.frames import rigid, transform
from pimper_torch.geometry.pinholes import look_at, pinholes
from pimper_torch.geometry.projection import project
from pimper_torch.records import Cameras
from pimper_torch.sfm.colmap import pinhole_lenses, pinhole_of
from pimper_torch.sfm.quarter_turns import turned_lens, turned_pose, turned_size


def arc(num_views: int, span_deg: float = 70.0) -> Cameras:
    return arc_cameras(
        num_views, width=64, height=48, focal_px=70.0, distance=4.0, span_deg=span_deg
    )


def row() -> Cameras:
    eyes = torch.stack([torch.tensor([x, 0.0, 5.0]).double() for x in (-1.0, 0.0, 0.3, 1.0)])
    ahead = look_at(eyes[1:2], torch.zeros(3).double(), torch.tensor([0.0, 1.0, 0.0]).double())
    rotation = ahead[:, :3, :3].expand(len(eyes), 3, 3)
    return pinholes(rigid(rotation, -(rotation @ eyes[..., None])[..., 0]), 70.0, 64, 48)


def transferred(cameras: Cameras) -> tuple[Cameras, torch.Tensor]:
    """Put cameras in another frame; also the similarity that leads back."""
    Q, _ = torch.linalg.qr(
        torch.randn(3, 3, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    )
    rotation = Q * torch.linalg.det(Q)
    known = rigid(0.3 * rotation, torch.tensor([0.4, 5.0, -1.0]).double())
    rotated = cameras.cam_from_world[:, :3, :3] @ rotation.mT
    centers = transform(known, cameras.centers_world)
    pose = rigid(rotated, -(rotated @ centers[..., None])[..., 0])
    return cameras.replace(cam_from_world=pose), torch.linalg.inv(known)


def turned(cameras: Cameras, quarters) -> Cameras:
    """Turn cameras one by one, by what structure from motion does with its lenses."""
    return cameras.replace(
        intrinsics=torch.stack(
            [
                pinhole_of(turned_lens(lens, number)).to(cameras.intrinsics)
                for lens, number in zip(pinhole_lenses(cameras), quarters, strict=True)
            ]
        ),
        cam_from_world=torch.stack(
            [
                turned_pose(pose, number)
                for pose, number in zip(cameras.cam_from_world, quarters, strict=True)
            ]
        ),
        sizes_px=torch.tensor(
            [
                turned_size(*size, number)
                for size, number in zip(cameras.sizes_px.tolist(), quarters, strict=True)
            ]
        ),
    )


@pytest.mark.parametrize("cameras", [arc(6), arc(6, span_deg=4.0), row()], ids=str)
@pytest.mark.parametrize("turns", [[0], [1], [2], [3], [0, 2], [1, 3, 0], [0, 0, 0, 1]])
def test_turns_of_photographs_are_undone_before_cameras_are_compared(cameras, turns):
    quarters = [turns[view % len(turns)] for view in range(cameras.num_views)]
    ours, back = transferred(turned(cameras, quarters))
    straight = standing_as(ours, cameras)
    assert_close(similarity_between_cameras(straight, cameras), back, atol=1e-9, rtol=0)
    figures = compare_cameras(straight, cameras, back, views=cameras.num_views)
    assert figures.mean_rotation_deg < 1e-6
    assert figures.mean_focal_percent < 1e-9
    points = torch.tensor([[0.1, 0.2, 0.3], [-0.2, 0.1, 0.0]]).double()
    pixels, _ = project(
        transform(torch.linalg.inv(back), points), straight.cam_from_world, straight.intrinsics
    )
    pixels_true, _ = project(points, cameras.cam_from_world, cameras.intrinsics)
    assert_close(pixels, pixels_true, atol=1e-8, rtol=0)


def test_cameras_that_are_merely_wrong_by_a_little_are_left_as_they_are():
    cameras = arc(8)
    noise = torch.randn(8, 3, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    wrong = torch.linalg.matrix_exp(0.1 * (noise - noise.mT)) @ cameras.cam_from_world[:, :3, :3]
    ours = cameras.replace(
        cam_from_world=rigid(wrong, -(wrong @ cameras.centers_world[..., None])[..., 0])
    )
    assert standing_as(ours, cameras) is ours


def test_one_camera_tells_no_turn():
    ours = turned(arc(1), [2])
    assert standing_as(ours, arc(1)) is ours
