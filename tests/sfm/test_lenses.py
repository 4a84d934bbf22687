import math
from dataclasses import replace

import pytest
import torch
from sparse_models import views_of
from torch.testing import assert_close

from pimper_torch.stages.sfm.lenses import choose_lenses, group_lenses
from pimper_torch.stages.sfm.reconstruct import structure_from_motion
from pimper_torch.stages.sfm.reconstruct_config import ReconstructConfig
from tests.sfm.ball import cameras_on_an_arc, photographs

NAN = math.nan
QUICK = ReconstructConfig(
    affine_shape=False, guided_pairs=0, starts=0, track_iterations=0, threads=1
)


@pytest.mark.parametrize(
    ("sizes", "focals", "groups"),
    [
        ([(9, 6)] * 3, [NAN] * 3, [0, 0, 0]),
        ([(9, 6), (6, 9), (9, 6)], [NAN] * 3, [0, 1, 0]),
        ([(9, 6), (6, 9), (9, 6)], [10.0, 10.1, 9.95], [0, 1, 0]),
        ([(9, 6)] * 4, [10.0, 15.0, 10.0, 15.1], [0, 1, 0, 1]),
        ([(9, 6)] * 4, [15.0, NAN, 10.0, NAN], [0, 1, 2, 1]),
        ([(9, 6)] * 3, [10.0, NAN, NAN], [0, 0, 0]),
        ([(9, 6), (8, 6), (8, 6)], [10.0, 10.0, NAN], [0, 1, 1]),
        ([(9, 6)] * 4, [10.0, 10.19, 10.21, 10.3], [0, 0, 1, 1]),
    ],
)
def test_photographs_of_one_size_and_focal_length_share_a_camera_model(sizes, focals, groups):
    assert group_lenses(sizes, focals) == groups


def test_one_shared_and_one_camera_model_each_follow_the_settings():
    views = views_of(torch.rand(3, 3, 6, 9), focals_px=torch.tensor([10.0, 15.0, NAN]))
    assert choose_lenses(views) == [0, 1, 2]
    assert choose_lenses(views, shared=True) == [0, 0, 0]
    views = views.replace(focals_px=torch.full((3,), NAN))
    assert choose_lenses(views) == [0, 0, 0]
    assert choose_lenses(views, own=True) == [0, 1, 2]


@pytest.mark.slow
def test_photographs_zoomed_according_to_exif_have_separate_camera_models():
    cameras, focals = cameras_on_an_arc(10), torch.tensor([840.0, 1176.0] * 5).double()
    K = cameras.intrinsics.clone()
    K[:, 0, 0] = K[:, 1, 1] = focals
    views = photographs(cameras.replace(intrinsics=K)).replace(focals_px=focals)
    model = structure_from_motion(views, replace(QUICK, guided_pairs=10, track_iterations=2))
    assert model.num_views == 10
    assert len({lens.camera for lens in model.lenses}) == 2
    found = torch.tensor([lens.params[0] for lens in model.lenses])
    assert_close(found[1::2] / found[::2], torch.full((5,), 1.4), rtol=0.01, atol=0)
    assert_close(found, focals.to(found), rtol=0.05, atol=0)  # on an arc, weakly determined
