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


def centers_of(faces):
    """Vertices are numbered row by row."""
    count = round((int(faces.max()) + 1) ** 0.5)
    vertices = torch.stack([faces % count, faces // count, 0 * faces], dim=-1)
    return vertices.double().mean(dim=1)


def test_a_surface_that_no_light_explains_is_contradicted_and_plain_surface_is_not():
    faces, strip = strips()
    support = torch.full_like(strip, Support.POINTS)
    support[(strip == 1) | (strip == 3)] = Support.LIGHT
    misfit = torch.full(strip.shape, 0.03, dtype=torch.float64)
    misfit[strip == 1] = 0.04
    misfit[strip == 3] = 0.2
    misfit[(strip == 3).nonzero()[::5, 0]] = 0.03  # some of it fits by chance
    misfit[(strip == 2).nonzero()[::3, 0]] = 0.5  # points support it, whatever the misfit
    misfit[strip == 4] = torch.nan
    assert (
        contradicted(centers_of(faces), faces, support, misfit, 0 * misfit) == (strip == 3)
    ).all()


def test_with_few_facets_to_compare_with_nothing_is_contradicted():
    faces, strip = strips()
    misfit = torch.full(strip.shape, 0.5, dtype=torch.float64)
    light = torch.full_like(strip, Support.LIGHT)
    assert not contradicted(centers_of(faces), faces, light, misfit, 0 * misfit).any()
    some = light.clone()
    some[:10] = Support.POINTS
    assert not contradicted(centers_of(faces), faces, some, misfit, 0 * misfit).any()


def test_a_few_facets_are_not_contradicted():
    faces, strip = strips()
    support = torch.full_like(strip, Support.POINTS)
    misfit = torch.full(strip.shape, 0.03, dtype=torch.float64)
    (cover,) = (strip == 3).nonzero(as_tuple=True)
    support[cover], misfit[cover] = Support.LIGHT, 0.2
    assert contradicted(centers_of(faces), faces, support, misfit, 0 * misfit).any()
    misfit[cover[6:]] = torch.nan  # light determines six
    assert not contradicted(centers_of(faces), faces, support, misfit, 0 * misfit).any()


def test_a_small_misfit_is_no_contradiction_however_many_times_the_usual_one():
    faces, strip = strips()
    support = torch.full_like(strip, Support.POINTS)
    support[strip == 3] = Support.LIGHT
    misfit = torch.full(strip.shape, 0.002, dtype=torch.float64)
    misfit[strip == 3] = 0.05  # 25 times as much, and still next to nothing
    assert not contradicted(centers_of(faces), faces, support, misfit, 0 * misfit).any()


def test_a_component_is_compared_with_facets_of_the_same_occlusion():
    faces, strip = strips(21)
    support = torch.full_like(strip, Support.POINTS)
    support[(strip == 1) | (strip == 3)] = Support.LIGHT
    # Half of what points support is a concavity too. So is strip 1; strip 3 closes an opening.
    occlusion = torch.where((strip == 0) | (strip == 1), 0.4, 0.02).double()
    misfit = 0.03 + 0.3 * occlusion
    misfit[strip == 1] = 0.2  # 5.6 times the open surface's, 1.3 times a concavity's
    assert not contradicted(centers_of(faces), faces, support, misfit, occlusion).any()
    misfit[strip == 3] = 0.2
    assert (
        contradicted(centers_of(faces), faces, support, misfit, occlusion) == (strip == 3)
    ).all()


def test_what_is_connected_with_plain_surface_is_contradicted_alone():
    """The surface in a mouth reaches the walls of the inside, which light explains."""
    faces, strip = strips(31)
    support = torch.where(strip == 0, int(Support.POINTS), int(Support.LIGHT))
    misfit = torch.full(strip.shape, 0.03, dtype=torch.float64)
    misfit[strip == 4] = 0.2
    misfit[(strip == 4).nonzero()[::4, 0]] = torch.nan
    found = contradicted(centers_of(faces), faces, support, misfit, 0 * misfit)
    assert found[strip == 4].double().mean() > 0.9
    assert found[(strip != 4)].double().mean() < 0.03
