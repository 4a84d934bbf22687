import pytest
import torch
from reliefs import ball, regions
from torch.testing import assert_close

from pimper_torch.errors import InputError
from pimper_torch.evidence.scenes.one_view import photograph, point_lights
from pimper_torch.single_view.photometric_stereo.visibility_subspaces import (
    _common_lights,
    find_subspaces,
    visibility_subspaces,
)

# Values nearer to zero than this fraction of the brightest are on the edge of a shadow.
EDGE = 0.05


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(4)


def shadowed(generator, noise=0.0, views=12):
    normals, mask = ball(56)
    lights = point_lights(views, generator, 60.0)
    made = photograph(normals, regions(56, generator), mask, lights, generator, noise)
    product = made.lights @ made.shading
    enough = (product > EDGE * product.max()).sum(dim=0) >= 5
    clear = (product.abs() > EDGE * product.max()) & enough
    return made, product > 0, clear


def apart(found, lights):
    """Tell the sine of the largest angle between the spans of two sets of lights."""
    one, other = torch.linalg.qr(found).Q, torch.linalg.qr(lights).Q
    return torch.linalg.matrix_norm(other - one @ (one.mT @ other), ord=2)


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_attached_shadows_and_the_span_of_the_lights_are_found(generator, noise):
    made, truth, clear = shadowed(generator, noise)
    assert (~truth).double().mean() > 0.05
    found = find_subspaces(made.images, made.mask, generator)
    # Noise of one per cent passes three deviations now and then.
    assert (found.lit != truth)[clear].double().mean() < (0.002 if noise else 1e-9)
    # Values just below zero, cut off, pass for lit ones just above.
    assert apart(found.lights, made.lights) < (0.01 if noise else 1e-3)
    assert found.visibility.shape[1] >= 2


def test_cast_shadows_are_found(generator):
    made, truth, clear = shadowed(generator, 0.005)
    images = made.images.clone()
    cast = torch.zeros_like(images[:, 0], dtype=torch.bool)
    cast[1:4, 20:34, 10:30] = True
    images = torch.where(cast[:, None], 0, images)
    expected = truth & ~cast[:, made.mask]
    enough = expected.sum(dim=0) >= 5
    found = visibility_subspaces(images, made.mask, generator, noise=0.005)
    assert (cast[:, made.mask] & truth).sum() > 500
    assert (found != expected)[clear & enough].double().mean() < 0.005


def test_values_that_are_too_bright_are_left_out(generator):
    made, truth, clear = shadowed(generator, 0.005)
    images = made.images.clone()
    gloss = torch.zeros_like(images[:, 0], dtype=torch.bool)
    gloss[2, 24:32, 24:32] = True
    images = torch.where(gloss[:, None], images + 0.5 * images.max(), images)
    found = visibility_subspaces(images, made.mask, generator, noise=0.005)
    assert not found[gloss[:, made.mask]].any()
    # Of the pixels with gloss, some that start from their brightest views lose the others too.
    others = clear & ~gloss.any(dim=0)[made.mask]
    assert (found != truth)[others].double().mean() < 0.005


def test_pixels_of_one_subspace_share_their_point_lights(generator):
    made, truth, clear = shadowed(generator)
    found = find_subspaces(made.images, made.mask, generator)
    sizes = torch.bincount(found.subspace[found.subspace >= 0])
    assert sizes[0] == sizes.max() > 50
    inside = found.subspace == 0
    seen = found.visibility[:, :1].expand(-1, int(inside.sum()))
    agree = (seen == truth[:, inside]) | ~clear[:, inside]
    assert agree.double().mean() > 0.98


def test_common_lights_join_subspaces_that_share_four_views(generator):
    lights = torch.randn(9, 3, generator=generator, dtype=torch.float64)
    visibility = torch.ones(9, 3, dtype=torch.bool)
    visibility[:2, 0] = False
    visibility[5:, 1] = False
    visibility[[0, 3], 2] = False
    bases = []
    for lit in visibility.mT:
        rotation = torch.randn(3, 3, generator=generator, dtype=torch.float64)
        bases.append(torch.linalg.qr(lights * lit[:, None] @ rotation).Q)
    found, covered = _common_lights(bases, visibility, torch.ones(3).double())
    assert covered.all()
    assert apart(found, lights) < 1e-7
    assert_close(found.mT @ found, torch.eye(3).double())


def test_the_same_generator_gives_the_same_answer(generator):
    made, _, _ = shadowed(generator)
    one = visibility_subspaces(made.images, made.mask, torch.Generator().manual_seed(1))
    other = visibility_subspaces(made.images, made.mask, torch.Generator().manual_seed(1))
    assert (one == other).all()


def test_what_does_not_fit_is_refused(generator):
    made, _, _ = shadowed(generator)
    with pytest.raises(InputError, match="3 views"):
        find_subspaces(made.images[:3], made.mask, generator)
    with pytest.raises(InputError, match="noise of 0"):
        find_subspaces(made.images, made.mask, generator, noise=0.0)
    scattered = torch.rand(made.images.shape, generator=generator, dtype=torch.float64)
    with pytest.raises(InputError, match="lie in one subspace"):
        find_subspaces(scattered, made.mask, generator, noise=0.001)
