import torch

from pimper_torch.coarse.contradicted import contradicted
from pimper_torch.records import Support


def strips(count=11):
    """A square of facets, and for each the strip that it lies in: a fifth of the width."""
    index = torch.arange(count * count).reshape(count, count)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = torch.stack([torch.stack([a, b, c], dim=-1), torch.stack([a, c, d], dim=-1)], dim=2)
    columns = torch.arange(count - 1) * 5 // (count - 1)
    strip = columns[None, :, None].expand(count - 1, -1, 2)
    return faces.reshape(-1, 3), strip.reshape(-1)


def test_a_lid_goes_and_plain_surface_stays():
    faces, strip = strips()
    support = torch.full_like(strip, Support.POINTS)
    support[(strip == 1) | (strip == 3)] = Support.LIGHT
    misfit = torch.full(strip.shape, 0.03, dtype=torch.float64)
    misfit[strip == 1] = 0.04
    misfit[strip == 3] = 0.2
    misfit[(strip == 3).nonzero()[::5, 0]] = 0.03  # some of it fits by chance
    misfit[(strip == 2).nonzero()[::3, 0]] = 0.5  # points bear it out, whatever light says
    misfit[strip == 4] = torch.nan
    assert (contradicted(faces, support, misfit) == (strip == 3)).all()


def test_with_little_to_compare_with_nothing_goes():
    faces, strip = strips()
    misfit = torch.full(strip.shape, 0.5, dtype=torch.float64)
    light = torch.full_like(strip, Support.LIGHT)
    assert not contradicted(faces, light, misfit).any()
    some = light.clone()
    some[:10] = Support.POINTS
    assert not contradicted(faces, some, misfit).any()


def test_what_is_dark_in_all_alike_is_not_called_a_lid():
    faces, strip = strips()
    support = torch.full_like(strip, Support.POINTS)
    support[strip == 3] = Support.LIGHT
    misfit = torch.full(strip.shape, 0.002, dtype=torch.float64)
    misfit[strip == 3] = 0.05  # 25 times as much, and still next to nothing
    assert not contradicted(faces, support, misfit).any()
