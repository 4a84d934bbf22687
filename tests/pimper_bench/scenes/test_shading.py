import pytest
import torch
from torch.nn.functional import normalize
from torch.testing import assert_close

from pimper_bench.scenes.scene_object import reflect
from pimper_torch.stages.relighting.lit_surface import facet_density

UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def hemisphere(steps=400):
    """Return directions above a plane, and the solid angle of each."""
    cosine = (torch.arange(steps, dtype=torch.float64) + 0.5) / steps
    rotation = 2 * torch.pi * (torch.arange(2 * steps, dtype=torch.float64) + 0.5) / (2 * steps)
    cosine, rotation = torch.meshgrid(cosine, rotation, indexing="ij")
    sine = (1 - cosine**2).sqrt()
    directions = torch.stack([sine * rotation.cos(), sine * rotation.sin(), cosine], dim=-1)
    return directions.reshape(-1, 3), 2 * torch.pi / cosine.numel()


def split(normals, to_light, to_eye, specular, roughness):
    shape = torch.broadcast_shapes(normals.shape, to_light.shape, to_eye.shape)
    normals, to_light, to_eye = (one.expand(shape) for one in (normals, to_light, to_eye))
    fill = to_light.new_ones(shape[:-1])
    return reflect(normals, to_light, to_eye, specular * fill, roughness * fill)


def test_without_specular_reflection_shading_is_lambertian(generator):
    to_light = normalize(torch.randn(50, 3, generator=generator, dtype=torch.float64), dim=-1)
    matte, mirrored = split(UP, to_light, UP, 0.0, 0.4)
    assert_close(matte, to_light[:, 2].clamp_min(0))
    assert (mirrored == 0).all()


@pytest.mark.parametrize("alpha", [0.05, 0.3, 1.0])
def test_the_facet_distribution_is_normalized(alpha):
    cosine = (torch.arange(100_000, dtype=torch.float64) + 0.5) / 100_000
    density = facet_density(cosine, torch.full_like(cosine, alpha))
    covered = 2 * torch.pi * (density * cosine).mean()
    assert_close(covered, torch.tensor(1.0, dtype=torch.float64), atol=1e-4, rtol=0)


@pytest.mark.parametrize("roughness", [0.3, 0.6, 1.0])
@pytest.mark.parametrize("tilt_deg", [0.0, 45.0, 75.0])
def test_a_white_surface_conserves_energy(roughness, tilt_deg):
    tilt = torch.deg2rad(torch.tensor(tilt_deg, dtype=torch.float64))
    to_eye = torch.stack([tilt.sin(), torch.zeros_like(tilt), tilt.cos()])
    directions, solid_angle = hemisphere()
    # By reciprocity the radiance received from lights of all directions equals that sent to all
    # directions.
    matte, mirrored = split(UP, directions, to_eye, 0.05, roughness)
    total = ((matte + mirrored) / torch.pi).sum() * solid_angle
    assert 0.7 < total < 1
    assert (mirrored / torch.pi).sum() * solid_angle > 0.01  # rough facets occlude each other


def test_reflectance_is_reciprocal(generator):
    pairs = normalize(torch.rand(2, 100, 3, generator=generator, dtype=torch.float64), dim=-1)
    there, back = (split(UP, *pair, 0.04, 0.3)[1] for pair in (pairs, pairs.flip(0)))
    assert_close(there / pairs[0, :, 2], back / pairs[1, :, 2])


def test_the_highlight_at_normal_incidence_has_its_closed_form():
    # D = 1 / (pi a^2), masking 1 / 4, Fresnel F: pi D F / 4.
    _, mirrored = split(UP, UP[None], UP[None], 0.04, 0.5)
    assert_close(mirrored[0], torch.tensor(0.04 / (4 * 0.25**2), dtype=torch.float64))


def test_a_point_light_below_the_horizon_gives_no_light():
    below = normalize(torch.tensor([[1.0, 0.0, -0.01]], dtype=torch.float64), dim=-1)
    for part in split(UP, below, UP, 0.05, 0.9):
        assert (part == 0).all()
