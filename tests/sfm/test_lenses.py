import math
from dataclasses import replace

import pytest
import torch
from torch.testing import assert_close

from pimper_torch.records import Views
from pimper_torch.sfm.colmap import bundle
from pimper_torch.sfm.doubt import doubt_one_lens
from pimper_torch.sfm.lenses import (
    choose_lenses,
    group_lenses,
    sensor_turns,
    turned_pixels,
    turned_views,
    turning,
)
from pimper_torch.sfm.reconstruct import structure_from_motion
from pimper_torch.sfm.reconstruct_config import ReconstructConfig
from tests.sfm.ball import (
    HEIGHT,
    WIDTH,
    cameras_on_an_arc,
    model_of,
    photographs,
    points_on_the_ball,
)

NAN = math.nan
QUICK = ReconstructConfig(
    affine_shape=False, guided_pairs=0, starts=0, track_iterations=0, threads=1
)


@pytest.mark.parametrize(
    ("sizes", "focals", "groups"),
    [
        ([(9, 6)] * 3, [NAN] * 3, [0, 0, 0]),
        ([(9, 6), (6, 9), (9, 6)], [NAN] * 3, [0, 0, 0]),
        ([(9, 6), (6, 9), (9, 6)], [10.0, 10.1, 9.95], [0, 0, 0]),
        ([(9, 6)] * 4, [10.0, 15.0, 10.0, 15.1], [0, 1, 0, 1]),
        ([(9, 6)] * 4, [15.0, NAN, 10.0, NAN], [0, 1, 2, 1]),
        ([(9, 6)] * 3, [10.0, NAN, NAN], [0, 0, 0]),
        ([(9, 6), (8, 6), (6, 8)], [10.0, 10.0, NAN], [0, 1, 1]),
        ([(9, 6)] * 4, [10.0, 10.19, 10.21, 10.3], [0, 0, 1, 1]),
    ],
)
def test_photographs_of_one_size_and_focal_length_are_of_one_lens(sizes, focals, groups):
    assert group_lenses(sizes, focals) == groups


def views_of(sizes, tags=None):
    wide, high = (max(sides) for sides in zip(*sizes, strict=True))
    generator = torch.Generator().manual_seed(7)
    views = Views(
        images=torch.rand(len(sizes), 3, high, wide, generator=generator),
        sizes_px=torch.tensor(sizes),
        names=tuple(map(str, range(len(sizes)))),
        focals_px=torch.full((len(sizes),), 10.0),
        orientations=None if tags is None else torch.tensor(tags),
    )
    images = views.images * views.inside[:, None]
    return views.replace(images=images, masks=(images[:, 0] > 0.5))


def test_photographs_that_stand_beside_others_that_lie_are_turned_as_exif_says():
    sizes = [(9, 6), (6, 9), (6, 9), (6, 9), (8, 8)]
    assert sensor_turns(views_of(sizes)) == (0, 1, 1, 1, 0)
    assert sensor_turns(views_of(sizes, [3, 6, 8, 1, 6])) == (0, 1, 3, 1, 0)
    assert sensor_turns(views_of([(6, 9)] * 3, [6, 8, 1])) == (0, 0, 0)


def test_photographs_turned_there_and_back_are_the_same():
    views = views_of([(9, 6), (6, 9), (5, 7), (4, 4)])
    quarters = [1, 3, 2, 0]
    there = turned_views(views, quarters)
    assert there.sizes_px.tolist() == [[6, 9], [9, 6], [5, 7], [4, 4]]
    assert not (there.masks & ~there.inside).any()
    back = turned_views(there, [-turns for turns in quarters])
    assert torch.equal(back.images, views.images)
    assert torch.equal(back.masks, views.masks)
    assert torch.equal(back.sizes_px, views.sizes_px)
    assert turned_views(views, [0, 4, 0, -8]) is views


def test_a_turn_is_a_matrix_on_pixels():
    pixels = torch.rand(10, 2, dtype=torch.float64)
    for quarters in range(4):
        matrix = turning(9, 6, quarters)
        found = torch.cat([pixels, torch.ones(10, 1, dtype=torch.float64)], dim=1) @ matrix.mT
        assert_close(found[:, :2], turned_pixels(pixels, 9, 6, quarters))


def test_one_lens_and_one_each_are_what_was_asked_for():
    views = views_of([(9, 6)] * 3).replace(focals_px=torch.tensor([10.0, 15.0, NAN]))
    assert choose_lenses(views) == [0, 1, 2]
    assert choose_lenses(views, shared=True) == [0, 0, 0]
    views = views.replace(focals_px=torch.full((3,), NAN))
    assert choose_lenses(views) == [0, 0, 0]
    assert choose_lenses(views, own=True) == [0, 1, 2]


def zoomed(views, cameras, factor, chosen):
    """Photograph with a lens that is so much longer: render anew, not cropped."""
    scale = torch.diag(torch.tensor([factor, factor, 1.0], dtype=torch.float64))
    center = torch.tensor([[1, 0, WIDTH / 2], [0, 1, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64)
    longer = center @ scale @ center.inverse() @ cameras.intrinsics
    close = photographs(cameras.replace(intrinsics=longer))
    images = views.images.clone()
    images[chosen] = close.images[chosen]
    return views.replace(images=images)


def focal_lengths(model):
    return torch.tensor([lens.params[0] for lens in model.lenses])


def test_every_other_photograph_zoomed_as_exif_says_is_of_a_lens_of_its_own():
    cameras = cameras_on_an_arc(10)
    views = zoomed(photographs(cameras), cameras, 1.4, [1, 3, 5, 7, 9])
    focals = torch.tensor([840.0, 1176.0] * 5, dtype=torch.float64)
    config = replace(QUICK, guided_pairs=10, track_iterations=2)
    model = structure_from_motion(views.replace(focals_px=focals), config)
    assert model.num_views == 10
    found = focal_lengths(model)
    assert len({lens.camera for lens in model.lenses}) == 2
    assert_close(found[1::2] / found[::2], torch.full((5,), 1.4), rtol=0.01, atol=0)
    assert_close(found, focals.to(found), rtol=0.05, atol=0)  # an arc tells it from distance badly


@pytest.mark.slow
def test_a_camera_that_is_held_upright_for_some_photographs_is_one_lens():
    cameras = cameras_on_an_arc()
    plain = photographs(cameras)
    quarters = [0, 1, 0, 3, 0, 1]
    tags = torch.tensor([{0: 1, 1: 6, 3: 8}[turns] for turns in quarters])
    views = turned_views(plain, quarters).replace(orientations=tags)
    expected = structure_from_motion(plain, QUICK)
    model = structure_from_motion(views, QUICK)
    assert model.names == expected.names == views.names
    # The same photographs came to COLMAP: the same numbers come out, but for what up is.
    depths, expected_depths = (
        (one.cam_from_world[:, 2, :3] @ one.points_world.mT + one.cam_from_world[:, 2, 3:])
        for one in (model, expected)
    )
    assert_close(depths, expected_depths, rtol=1e-9, atol=0)
    assert torch.equal(focal_lengths(model), focal_lengths(expected))
    for lens, size in zip(model.lenses, views.sizes_px.tolist(), strict=True):
        assert [lens.width, lens.height] == size
        assert lens.params[1:3] == (size[0] / 2, size[1] / 2)
    untagged = structure_from_motion(views.replace(orientations=None), QUICK)
    assert_close(
        focal_lengths(untagged), focal_lengths(expected), rtol=0.03, atol=0
    )  # features differ


@pytest.mark.parametrize(("factor", "doubted"), [(1.0, False), (1.02, False), (1.4, True)])
def test_photographs_of_two_lenses_that_are_taken_for_one_are_warned_of(factor, doubted, generator):
    cameras = cameras_on_an_arc(8)
    K = cameras.intrinsics.clone()
    K[1::2, 0, 0] *= factor
    K[1::2, 1, 1] *= factor
    points = points_on_the_ball(300, generator)
    two = model_of(cameras.replace(intrinsics=K), points, generator, 0.2)
    model = bundle(two, 1.0)  # of one lens
    reason = doubt_one_lens(model)
    assert bool(reason) == doubted
    if doubted:
        assert "a lens of its own" in reason
        assert "--reconstruct.own-cameras" in reason
        each = tuple(lens.replace(camera=view + 1) for view, lens in enumerate(model.lenses))
        assert doubt_one_lens(model.replace(lenses=each)) == ""
