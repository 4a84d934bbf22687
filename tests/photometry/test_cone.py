import torch
from torch.nn.functional import normalize
from torch.testing import assert_close

from pimper_torch.stages.photometry.cone import project_to_cone, split_shading, tangent_columns


def test_projection_is_the_nearest_point_of_the_cone(generator):
    shading = torch.randn(64, 4, generator=generator, dtype=torch.float64)
    found = project_to_cone(shading)
    assert_close(found[:, 0], found[:, 1:].norm(dim=-1))  # on the cone, so not the identity

    rays = torch.ones(4096, 4, dtype=torch.float64)
    rays[:, 1:] = normalize(torch.randn(4096, 3, generator=generator, dtype=torch.float64))
    best = (shading @ rays.T).clamp_min(0) / 2  # least squares along a ray; |ray|^2 = 2
    rivals = (shading[:, None] - best[..., None] * rays).norm(dim=-1).amin(dim=1)
    assert ((found - shading).norm(dim=-1) <= rivals + 1e-12).all()  # float64 rounding


def test_projection_of_vectors_without_direction_is_zero_with_zero_gradient():
    shading = torch.tensor(
        [[0.0, 0, 0, 0], [2.0, 0, 0, 0], [-3.0, 0, 0, 1.0]], dtype=torch.float64
    ).requires_grad_()
    found = project_to_cone(shading)
    found.sum().backward()
    assert (found == 0).all()
    assert (shading.grad == 0).all()


def test_projection_is_differentiable_on_the_inside_and_outside(generator):
    shading = torch.randn(6, 4, generator=generator, dtype=torch.float64) + 1.5
    assert torch.autograd.gradcheck(project_to_cone, shading.requires_grad_())


def test_tangents_span_the_directions_that_stay_on_the_cone(generator):
    shading = project_to_cone(torch.randn(5, 9, 4, generator=generator, dtype=torch.float64) + 1).mT
    small = 1e-6
    for column in tangent_columns(shading):
        moved = shading + small * column
        off = moved - project_to_cone(moved.mT).mT
        assert off.abs().max() < 1e-10  # second order in the step
    albedo, normal = split_shading(shading.mT)
    assert_close(albedo[..., None] * normal, shading.mT[..., 1:])
