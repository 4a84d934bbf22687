import pytest
import torch
from torch.nn.functional import normalize
from torch.testing import assert_close

from pimper_torch.errors import ConfigError, ReconstructionError
from pimper_torch.evidence.baselines.lim import Lim, LimConfig, bas_relief_matrix
from pimper_torch.evidence.baselines.rank_three import (
    Rank3,
    Spans,
    ambiguity_between_points,
    factorize_rank_three,
    matrix_between_lights,
    solve_vectors,
)

TWICE = LimConfig(samples_per_pixel=(0.5, 1.0))


def paraboloid_spans(generator):
    """Exact normals along straight ways over z = 0.3 x^2 - 0.2 x y + 0.4 y^2."""
    start = torch.randn(80, 2, generator=generator, dtype=torch.float64)
    end = start + 0.5 * torch.randn(80, 2, generator=generator, dtype=torch.float64)

    def depth(xy):
        x, y = xy.unbind(dim=-1)
        return 0.3 * x**2 - 0.2 * x * y + 0.4 * y**2

    along = (torch.arange(24, dtype=torch.float64) + 0.5) / 24
    x, y = (start[:, None] + along[:, None] * (end - start)[:, None]).unbind(dim=-1)
    slopes = torch.stack([0.6 * x - 0.2 * y, 0.8 * y - 0.2 * x], dim=-1)
    normals = normalize(torch.cat([slopes, -torch.ones_like(slopes[..., :1])], dim=-1), dim=-1)
    albedo = 0.2 + torch.rand(80, 24, 1, generator=generator, dtype=torch.float64)
    step = torch.cat([end - start, (depth(end) - depth(start))[:, None]], dim=1)
    return step, albedo * normals


def test_points_recover_a_known_matrix():
    generator = torch.Generator().manual_seed(6)
    step, vectors = paraboloid_spans(generator)
    hidden = torch.tensor([[1.0, 0.4, -0.2], [-0.3, 1.5, 0.1], [0.2, -0.3, 0.7]]).double()
    spans = Spans(
        step=step,
        vectors=vectors @ torch.linalg.inv(hidden).T,
        valid=torch.ones(80, 24, dtype=torch.bool),
    )
    start = hidden + 0.2 * torch.randn(3, 3, generator=generator, dtype=torch.float64)
    found = ambiguity_between_points(spans, start)
    # Midpoints integrate linear slopes exactly, so that only rounding is left.
    assert_close(found, hidden / hidden.norm(), atol=1e-6, rtol=0)
    assert (start / start.norm() - hidden / hidden.norm()).norm() > 0.1


def test_wrong_points_hardly_move_the_matrix():
    generator = torch.Generator().manual_seed(6)
    step, vectors = paraboloid_spans(generator)
    step[:10, 2] += 3
    valid = torch.ones(80, 24, dtype=torch.bool)
    valid[:, ::5] = False
    spans = Spans(step=step, vectors=torch.where(valid[..., None], vectors, 0), valid=valid)
    found = ambiguity_between_points(spans, torch.eye(3).double())
    eye = torch.eye(3).double() / 3**0.5
    assert_close(found, eye, atol=0.02, rtol=0)


def test_factors_of_a_masked_matrix_give_back_what_is_missing():
    generator = torch.Generator().manual_seed(7)
    lights = torch.randn(10, 3, generator=generator, dtype=torch.float64)
    vectors = torch.randn(3, 200, generator=generator, dtype=torch.float64)
    lights[:, 2], vectors[2] = lights[:, 2] + 4, vectors[2].abs() + 1
    whole = lights @ vectors
    seen = torch.rand(10, 200, generator=generator) < 0.7
    found = factorize_rank_three(whole * seen, seen, alternations=500, tolerance=1e-10)
    rebuilt = found @ solve_vectors(whole * seen, seen, found)
    often = seen.sum(dim=0) >= 4
    assert_close(rebuilt[:, often], whole[:, often], atol=1e-3, rtol=1e-3)
    move = matrix_between_lights(found, lights)
    factors = Rank3(lights=found, vectors=solve_vectors(whole * seen, seen, found)).moved(move)
    assert_close(factors.lights, lights, atol=1e-3, rtol=1e-3)
    assert_close(factors.vectors[:, often], vectors[:, often], atol=1e-2, rtol=1e-2)


def test_the_matrix_of_a_bas_height_field_transformation_changes_slopes_as_depths_change():
    b = torch.tensor([0.2, -0.1, -0.9], dtype=torch.float64)
    moved = bas_relief_matrix(torch.tensor([0.3, -0.4, 2.0, 9.0], dtype=torch.float64)) @ b
    assert_close(-moved[0] / moved[2], 2 * (-b[0] / b[2]) + 0.3)
    assert_close(-moved[1] / moved[2], 2 * (-b[1] / b[2]) - 0.4)


@pytest.mark.parametrize("shape", ["sphere", pytest.param("bumps", marks=pytest.mark.slow)])
def test_without_ambient_light_rounds_come_ever_nearer_to_the_truth(
    shape, photographed, compared, request
):
    truth, scene, coarse = photographed(request.getfixturevalue(shape), ambient=0.0)
    facets = compared(coarse.mesh, truth, coarse)
    once = compared(Lim(LimConfig(samples_per_pixel=(1.0,)))(scene, coarse).mesh, truth, coarse)
    found = Lim(TWICE)(scene, coarse)
    twice = compared(found.mesh, truth, coarse)
    assert once.relative_error < 0.1 * facets.relative_error  # measured 0.03 and 0.04
    assert twice.relative_error < 0.5 * once.relative_error  # registered again
    assert twice.mean_angle_deg < 0.2
    assert twice.coverage > facets.coverage - 0.03
    directions = normalize(found.lights_world[:, 1:], dim=1)
    true = normalize(truth.lights_world[:, 1:].float(), dim=1)
    assert torch.rad2deg((directions * true).sum(dim=1).clamp(-1, 1).acos()).max() < 2
    assert (found.lights_world[:, 0] == 0).all()


def test_missing_data_is_left_to_the_mask(photographed, compared, sphere):
    truth, scene, coarse = photographed(sphere, ambient=0.0)
    masks = torch.ones_like(scene.views.images[:, 0]) > 0
    masks[0] = False
    masks[4:7, 30:60] = False
    masked = scene.replace(views=scene.views.replace(masks=masks))
    found = Lim(TWICE)(masked, coarse)
    assert compared(found.mesh, truth, coarse).mean_angle_deg < 0.5
    assert found.lights_world[0].abs().max() < 1e-3  # a view without data has no light


def test_what_cannot_be_reconstructed_is_refused(photographed, sphere):
    _, scene, coarse = photographed(sphere)
    aside = torch.tensor([0.0, 60.0, -60.0])  # in front of the cameras, in no frame
    three = scene.replace(
        views=scene.views.take(range(3)),
        cameras=scene.cameras.take(range(3)),
        observation_view=scene.observation_view % 3,
    )
    with pytest.raises(ReconstructionError, match="3 views are registered, and at least 4"):
        Lim()(three, coarse.replace(reference=1))
    with pytest.raises(ReconstructionError, match="sparse points"):
        Lim()(scene.replace(points_world=scene.points_world + aside), coarse)
    masks = torch.zeros_like(scene.views.images[:, 0]) > 0
    masks[:2] = True
    with pytest.raises(ReconstructionError, match="seen lit in 4 views"):
        Lim()(scene.replace(views=scene.views.replace(masks=masks)), coarse)
    with pytest.raises(ConfigError, match="samples_per_pixel"):
        LimConfig(samples_per_pixel=())
