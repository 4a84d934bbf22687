import torch
from torch.testing import assert_close

from pimper_bench.scenes.render_in_memory import Sphere, render_shape
from pimper_bench.scenes.scene_cameras import arc_cameras
from pimper_bench.scenes.true_clouds import sparse_scene
from pimper_torch.stages.coarse.surface import point_covariances


def noisy_cloud(noise_px, seed, span_deg=50.0):
    cameras = arc_cameras(
        6, width=160, height=120, focal_px=200.0, distance=4.0, sway_deg=0.0, span_deg=span_deg
    )
    lights = torch.tensor([[0.4, 0.0, 0.0, 0.4]], dtype=torch.float64).expand(6, 4)
    scene = render_shape(Sphere(), cameras, lights, lambda points: torch.ones_like(points))
    generator = torch.Generator().manual_seed(seed)
    return sparse_scene(scene, 1500, generator, noise_px=noise_px, dtype=torch.float64)


def test_covariances_match_the_errors_of_triangulated_points():
    noise = 0.3
    cloud = noisy_cloud(noise, 0)
    everyone = torch.arange(len(cloud.points_world))
    covariance = point_covariances(cloud, everyone)
    # The points came from a sphere: the radial error is known without knowing the point.
    radial = cloud.points_world / cloud.points_world.norm(dim=1, keepdim=True)
    predicted = torch.einsum("pi,pij,pj->p", radial, covariance, radial)
    error = cloud.points_world.norm(dim=1) - 1
    ratio = float((error.square() / predicted).mean())
    assert 0.6 < ratio < 1.6  # the triangulation is not weighted by depth, nor noise by track
    # Points with a larger predicted error have a larger one.
    order = predicted.argsort()
    half = len(order) // 2
    spread = [float(error[part].square().mean()) for part in (order[:half], order[half:])]
    assert spread[1] > 1.2 * spread[0]


def test_points_without_error_are_certain_and_all_covariances_are_symmetric():
    cloud = noisy_cloud(0.0, 2)
    covariance = point_covariances(cloud, torch.arange(20))
    assert covariance.abs().max() < 1e-6  # rounding of the depth maps
    noisy = point_covariances(noisy_cloud(0.3, 2), torch.arange(20))
    assert_close(noisy, noisy.mT)
    assert (torch.linalg.eigvalsh(noisy) > 0).all()
