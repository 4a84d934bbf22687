import torch
from torch.nn.functional import avg_pool2d

from pimper_torch.single_view.factorization.estimate_gamma import camera_moved

VIEWS, SIZE = 8, 64


def series(generator, shift, contrast=0.2, noise=0.0):
    """A textured plane under a slope of light that changes, moved by so many pixels a view."""
    grain = torch.rand(1, 1, 2 * SIZE, 2 * SIZE, generator=generator)
    texture = avg_pool2d(grain, 3, 1, 1) - 0.5
    lights = 0.2 * torch.randn(VIEWS, 2, generator=generator)
    ramp = torch.linspace(-1, 1, SIZE)
    images = []
    for view, (across, down) in enumerate(lights):
        start = view * shift
        albedo = 0.5 + contrast * texture[0, :, start : start + SIZE, 3 : SIZE + 3]
        images.append(albedo * (1 + across * ramp + down * ramp[:, None]))
    stacked = torch.stack(images)
    return (stacked + noise * torch.randn(stacked.shape, generator=generator)).clamp(0, 1)


def test_details_that_stay_are_those_of_a_fixed_camera(generator):
    everywhere = torch.ones(SIZE, SIZE, dtype=torch.bool)
    assert not camera_moved(series(generator, 0), everywhere)
    assert not camera_moved(series(generator, 0, noise=0.01), everywhere)


def test_details_that_move_are_not(generator):
    assert camera_moved(series(generator, 6), torch.ones(SIZE, SIZE, dtype=torch.bool))


def test_without_details_nothing_is_said(generator):
    everywhere = torch.ones(SIZE, SIZE, dtype=torch.bool)
    assert not camera_moved(series(generator, 6, contrast=0, noise=0.02), everywhere)
    assert not camera_moved(series(generator, 6, contrast=0), everywhere)


def test_only_the_object_counts(generator):
    still, moving = series(generator, 0), series(generator, 6)
    object_here = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    object_here[:, SIZE // 2 :] = True
    both = torch.where(object_here, moving, still)
    assert camera_moved(both, object_here)
    assert not camera_moved(both, ~object_here)
