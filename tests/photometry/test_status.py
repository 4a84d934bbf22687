import torch

from pimper_torch.records import PatchStatus
from pimper_torch.stages.photometry.status import light_varies, photometric_status


def test_light_variation_is_the_ratio_of_the_third_singular_value(generator):
    lights = torch.randn(30, 8, 4, generator=generator, dtype=torch.float64)
    lights[:, :, 2:] *= 0.1 * torch.rand(30, 1, 1, generator=generator, dtype=torch.float64)
    lights[0, :, 1:] = 0  # one light for all, at any exposure
    fraction = torch.rand(30, 8, generator=generator, dtype=torch.float64)
    unit = lights / lights.norm(dim=2, keepdim=True)
    values = torch.linalg.svdvals(fraction.sqrt()[..., None] * unit)
    ratio = values[:, 2] / values[:, 0]
    least = float(ratio.quantile(0.45))  # between two patches
    found = light_varies(lights, fraction, least)
    assert (found == (ratio >= least)).all()
    assert not light_varies(lights, fraction, 0.0)[0]
    exposure = 0.1 + torch.rand(30, 8, 1, generator=generator, dtype=torch.float64)
    assert (light_varies(exposure * lights, fraction, least) == found).all()


def test_a_patch_has_the_first_status_that_applies(generator):
    lights = torch.randn(5, 6, 4, generator=generator)
    lights[1] = lights[1, :1]
    seen = torch.ones(5, 6, 10, dtype=torch.bool)
    seen[2, 3:] = False
    seen[3:] = False
    finite = torch.tensor([True, True, True, False, False])
    observed = torch.tensor([True, True, True, True, False])
    found = photometric_status(observed, finite, seen, lights, 4, 0.02)
    assert found.tolist() == [
        PatchStatus.DETERMINED,
        PatchStatus.CONSTANT_LIGHT,
        PatchStatus.FEW_VIEWS,
        PatchStatus.NOT_FINITE,
        PatchStatus.UNSEEN,
    ]
