import pytest
import torch
from reliefs import ball, bumps, regions
from torch.testing import assert_close

from pimper_torch.errors import InputError, PimperWarning
from pimper_torch.evidence.scenes.one_view import photograph, point_lights
from pimper_torch.single_view.factorization.bas_relief import BasRelief
from pimper_torch.single_view.photometric_stereo.chromaticity import (
    chromaticities,
    chromaticity_groups,
)
from pimper_torch.single_view.photometric_stereo.colour_profiles import (
    join_groups,
    resolve_by_colour_profiles,
    same_normals,
)

HIDDEN = BasRelief(
    mu=torch.tensor(0.7).double(), nu=torch.tensor(-0.4).double(), lam=torch.tensor(1.6).double()
)


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(2)


def error_deg(shading, normals):
    cross = torch.linalg.cross(shading, normals, dim=0).norm(dim=0)
    return torch.rad2deg(torch.atan2(cross, (shading * normals).sum(dim=0))).mean()


def seen(generator, shape="ball", noise=0.0, views=10):
    normals, mask = ball(40) if shape == "ball" else bumps(40, generator)
    lights = point_lights(views, generator)
    return photograph(normals, regions(40, generator), mask, lights, generator, noise)


@pytest.mark.parametrize("shape", ["ball", "bumps"])
def test_the_relief_is_exact_where_colours_and_images_are(generator, shape):
    made = seen(generator, shape)
    b, lights = HIDDEN.on_shading(made.shading), HIDDEN.on_lights(made.lights)
    found = resolve_by_colour_profiles(made.images, made.mask, b, lights)
    assert error_deg(found.on_shading(b), made.normals) < 1e-4  # the joining's iterations
    moved = found.on_lights(lights).mT
    assert error_deg(moved, made.lights.mT) < 1e-4


def test_one_per_cent_of_noise_costs_little_more_than_it_must(generator):
    made = seen(generator, noise=0.01)
    # Vectors by least squares on what is lit.
    values = made.images.sum(dim=1)[:, made.mask]
    lit = (values > 0.05 * values.max()).double()
    normal = torch.einsum("vi,vp,vj->pij", made.lights, lit, made.lights)
    known = lit.sum(dim=0) >= 4
    rhs = torch.einsum("vi,vp->pi", made.lights, lit * values)
    b = torch.linalg.solve(normal + 1e-9 * torch.eye(3).double(), rhs).mT * known
    floor = error_deg(b[:, known], made.normals[:, known])
    b, lights = HIDDEN.on_shading(b), HIDDEN.on_lights(made.lights)
    found = resolve_by_colour_profiles(made.images, made.mask, b, lights)
    assert floor > 0.5
    assert error_deg(found.on_shading(b)[:, known], made.normals[:, known]) < floor + 0.3


def test_point_lights_of_different_colours_do_not_matter(generator):
    made = seen(generator)
    tint = 0.5 + torch.rand(10, 3, 1, 1, generator=generator, dtype=torch.float64)
    plain, known = chromaticities(made.images, made.mask)
    tinted, _ = chromaticities(made.images * tint, made.mask)
    shift = (tinted - plain)[:, known]
    # Pixels are seen by different point lights; the alternation connects them up to its last step.
    assert_close(shift, shift[:, :1].expand_as(shift), atol=1e-3, rtol=0)
    assert shift.abs().max() > 0.01 or tint.std() > 0.1


def test_groups_are_the_paints(generator):
    made = seen(generator, noise=0.002)
    groups = chromaticity_groups(made.images, made.mask)
    paints = torch.unique(made.albedo, dim=1, return_inverse=True)[1]
    kept = groups >= 0
    assert kept.double().mean() > 0.95
    table = torch.zeros(int(paints.max()) + 1, int(groups.max()) + 1)
    table.index_put_((paints[kept], groups[kept]), torch.ones(int(kept.sum())), accumulate=True)
    assert ((table > 0).sum(dim=0) == 1).all()  # one paint a group
    assert ((table > 0).sum(dim=1) <= 1).all()  # one group a paint


def test_pixels_of_one_normal_tell_the_ratio_of_albedos(generator):
    normals, mask = ball(40)
    albedo = torch.ones(40, 40, 1, dtype=torch.float64)
    albedo[::2] = 3.0
    made = photograph(normals, albedo, mask, point_lights(8, generator), generator)
    profiles = made.images[:, 0, mask]
    groups = (made.albedo[0] > 2).long()
    pairs = same_normals(profiles, groups, 0.05)
    assert pairs.shape[1] > 50
    angle = torch.linalg.cross(made.normals[:, pairs[0]], made.normals[:, pairs[1]], dim=0)
    assert angle.norm(dim=0).median() < 0.1
    joined, log_ratio = join_groups(pairs, profiles.norm(dim=0).log(), groups)
    assert (joined == 0).all()
    found = (log_ratio[groups == 1].mean() - log_ratio[groups == 0].mean()).exp()
    assert_close(found, torch.tensor(3.0).double(), atol=0.05, rtol=0)
    apart, nothing = join_groups(pairs[:, :5], profiles.norm(dim=0).log(), groups)
    assert_close(apart, groups)
    assert (nothing == 0).all()


def test_linked_groups_resolve_what_none_of_them_can_alone(generator):
    # Each paint covers a narrow ring, on which normals lie on a cone: |G b| constant on a ring
    # for a family of reliefs. Sharing normals, the rings are one.
    normals, mask = ball(60)
    ring = ((torch.acos(-normals[..., 2].clamp(-1, 0)) / 0.2).long() % 3)[..., None]
    palette = torch.tensor([[0.9, 0.3, 0.3], [0.2, 0.5, 0.2], [0.2, 0.3, 1.0]], dtype=torch.float64)
    albedo = palette[ring[..., 0]]
    made = photograph(normals, albedo, mask, point_lights(12, generator), generator)
    b, lights = HIDDEN.on_shading(made.shading), HIDDEN.on_lights(made.lights)
    found = resolve_by_colour_profiles(made.images, made.mask, b, lights)
    assert error_deg(found.on_shading(b), made.normals) < 0.1


def test_greys_are_warned_of(generator):
    made = seen(generator)
    grey = made.images.mean(dim=1, keepdim=True).expand_as(made.images)
    with pytest.warns(PimperWarning, match="still varies"):
        resolve_by_colour_profiles(grey, made.mask, made.shading, made.lights)


def test_what_does_not_fit_is_refused(generator):
    made = seen(generator)
    b, lights = made.shading, made.lights
    with pytest.raises(InputError, match="one light a view"):
        resolve_by_colour_profiles(made.images, made.mask, b[:, 1:], lights)
    with pytest.raises(InputError, match="have 1 channel"):
        resolve_by_colour_profiles(made.images[:, :1], made.mask, b, lights)
    with pytest.raises(InputError, match="groups of one colour"):
        resolve_by_colour_profiles(made.images, made.mask, 0 * b, lights)
    with pytest.raises(InputError, match="parallel"):
        resolve_by_colour_profiles(made.images, made.mask, b[:, :1].expand_as(b), lights)
    with pytest.raises(InputError, match="bright in all channels"):
        chromaticity_groups(0 * made.images, made.mask)
