import torch
from torch.testing import assert_close

from pimper_bench.scenes.scene_cameras import arc_cameras
from pimper_torch.geometry.pinholes import look_at
from pimper_torch.geometry.projection import project


def test_look_at_centres_the_target_with_up_upwards():
    eyes = torch.tensor([[3.0, 1.0, 2.0], [-1.0, 4.0, 0.5]], dtype=torch.float64)
    target = torch.tensor([0.2, -0.1, 0.3], dtype=torch.float64)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    cam_from_world = look_at(eyes, target, up)
    rotation = cam_from_world[:, :3, :3]
    assert_close(torch.linalg.det(rotation), torch.ones(2, dtype=torch.float64))
    K = torch.tensor([[50.0, 0, 20], [0, 50, 15], [0, 0, 1]], dtype=torch.float64)
    points = torch.stack([target, target + 0.1 * up])
    pixels, depth = project(points, cam_from_world, K)
    assert_close(pixels[:, 0], torch.tensor([[20.0, 15.0]] * 2, dtype=torch.float64))
    assert_close(depth[:, 0], (eyes - target).norm(dim=1))
    assert (pixels[:, 1, 1] < 15).all()  # v counts down
    assert_close(pixels[:, 1, 0], torch.full((2,), 20.0, dtype=torch.float64))


def test_an_arc_spans_its_angle_at_its_distance():
    cameras = arc_cameras(
        5, width=64, height=48, focal_px=80.0, distance=3.0, span_deg=50.0, sway_deg=0.0
    )
    eyes = cameras.centers_world
    assert_close(eyes.norm(dim=1), torch.full((5,), 3.0, dtype=torch.float64))
    cosine = (eyes[0] @ eyes[-1]) / 9
    assert_close(torch.rad2deg(torch.acos(cosine)), torch.tensor(50.0, dtype=torch.float64))
    assert_close(eyes[2], torch.tensor([0.0, 0.0, 3.0], dtype=torch.float64))
    assert cameras.sizes_px.tolist() == [[64, 48]] * 5
