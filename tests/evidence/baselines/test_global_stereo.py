import pytest
import torch

from pimper_torch.errors import ConfigError, ReconstructionError
from pimper_torch.evidence.baselines.global_stereo import GlobalStereo, GlobalStereoConfig
from pimper_torch.evidence.baselines.one_matrix import as_problem, solve_whole
from pimper_torch.evidence.baselines.template import Matrix
from pimper_torch.kernels.switch import using
from pimper_torch.photometry.balm import solve_balm

HALF = GlobalStereoConfig(samples_per_pixel=0.5)


def small_matrix():
    generator = torch.Generator().manual_seed(9)
    normals = torch.randn(40, 3, generator=generator)
    normals[:, 2] = -normals[:, 2].abs() - 0.5
    normals = normals / normals.norm(dim=1, keepdim=True)
    lights = torch.randn(7, 4, generator=generator)
    lights[:, 0] += 2
    shading = torch.cat([torch.ones(1, 40), normals.T]) * torch.rand(40, generator=generator)
    seen = torch.rand(7, 40, generator=generator) < 0.8
    radiance = (lights @ shading + 0.02 * torch.randn(7, 40, generator=generator)) * seen
    start = lights + 0.1 * torch.randn(7, 4, generator=generator)
    return Matrix(radiance=radiance, seen=seen, normals=normals), start, shading


def test_chunks_give_what_the_solver_gives_in_one_piece(monkeypatch):
    matrix, lights, shading = small_matrix()
    whole = solve_balm(as_problem(matrix, lights, shading), 20, 1e-9)
    monkeypatch.setattr("pimper_torch.evidence.baselines.one_matrix.CHUNK", 7)
    chunked = solve_whole(matrix, lights, shading, 20, 1e-9)
    assert torch.allclose(chunked.lights, whole.lights[0], atol=2e-4)
    assert torch.allclose(chunked.shading, whole.shading[0], atol=2e-4)
    assert not chunked.converged
    monkeypatch.undo()
    assert solve_whole(matrix, lights, shading, 1000, 1e-2).converged


def test_one_matrix_recovers_a_sphere_where_the_model_holds(photographed, compared, sphere):
    truth, scene, coarse = photographed(sphere)
    found = GlobalStereo(HALF)(scene, coarse)
    ours = compared(found.mesh, truth, coarse)
    facets = compared(coarse.mesh, truth, coarse)
    assert ours.mean_angle_deg < 1.5  # measured 0.74; the facets' own normals 2.3
    assert ours.relative_error < 0.3 * facets.relative_error  # measured 0.20
    assert ours.coverage > facets.coverage - 0.03  # half a sample at the rim
    assert found.reference == scene.views.names[coarse.reference]
    assert found.names == scene.views.names
    assert found.lights_world.shape == (9, 4)
    assert found.mesh.albedo.shape == (len(found.mesh.vertices_world), 3)


@pytest.mark.slow
def test_one_matrix_sees_relief_that_the_facets_do_not(photographed, compared, bumps):
    truth, scene, coarse = photographed(bumps)
    # It ends in one of two minima, by the processor's rounding: 4.0 degrees and 1.8 % on one, 7.7
    # to 8.5 degrees and 3.4 to 4.0 % on another, there also with noise of 1e-7 to 1e-5.
    with using("torch"):
        ours = compared(GlobalStereo(HALF)(scene, coarse).mesh, truth, coarse)
    facets = compared(coarse.mesh, truth, coarse)  # 15.8 degrees and 4.5 %
    assert ours.mean_angle_deg < 0.6 * facets.mean_angle_deg
    assert ours.relative_error < 0.95 * facets.relative_error


def test_a_view_without_data_does_no_harm(photographed, compared, sphere):
    truth, scene, coarse = photographed(sphere)
    masks = torch.ones_like(scene.views.images[:, 0]) > 0
    masks[0] = False
    masks[5, :45] = False  # half a view
    masked = scene.replace(views=scene.views.replace(masks=masks))
    found = GlobalStereo(HALF)(masked, coarse)
    assert found.mesh.vertices_world.isfinite().all()
    assert found.lights_world.isfinite().all()
    assert compared(found.mesh, truth, coarse).mean_angle_deg < 2.0


def test_what_cannot_be_factorized_is_refused(photographed, sphere):
    _, scene, coarse = photographed(sphere)
    aside = torch.tensor([0.0, 60.0, -60.0])  # in front of the cameras, in no frame
    three = scene.replace(
        views=scene.views.take(range(3)),
        cameras=scene.cameras.take(range(3)),
        observation_view=scene.observation_view % 3,
    )
    with pytest.raises(ReconstructionError, match="3 views are registered, and at least 4"):
        GlobalStereo()(three, coarse.replace(reference=1))
    with pytest.raises(ReconstructionError, match="sparse points"):
        GlobalStereo()(scene.replace(points_world=scene.points_world + aside), coarse)
    masks = torch.zeros_like(scene.views.images[:, 0]) > 0
    masks[:3] = True
    seldom = scene.replace(views=scene.views.replace(masks=masks))
    with pytest.raises(ReconstructionError, match="seen lit in 4 views"):
        GlobalStereo()(seldom, coarse)
    with pytest.raises(ConfigError, match="min_views"):
        GlobalStereoConfig(min_views=3)
