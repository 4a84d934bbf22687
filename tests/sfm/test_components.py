import pytest
import torch

from pimper_torch.geometry.rigid import rigid
from pimper_torch.runtime.errors import ReconstructionError
from pimper_torch.stages.sfm.diagnose import choose_component, count_spread_views

NAMES = tuple(f"{index:02d}.jpg" for index in range(20))


@pytest.mark.parametrize(
    ("parts", "spread", "chosen"),
    [
        ([NAMES[:4], NAMES[4:20]], [4, 16], 1),  # a clear majority
        ([NAMES[:5]], [5], 0),  # small, without a rival
        ([NAMES[:8], NAMES[2:8]], [8, 6], 0),  # a subset of the largest is not a rival
        ([NAMES, NAMES[:13]], [0, 13], 1),  # the larger one has no depth
        ([NAMES, NAMES[:7]], [2, 7], 1),  # nor does it compete with less than the majority
    ],
)
def test_the_largest_component_with_depth_is_kept(parts, spread, chosen):
    assert choose_component(parts, spread, NAMES, 0.6) == chosen


LOW = "sides from low down in every session"
FEW = "registered {} of 6 photographs; at least 3 are needed.*05.jpg"


@pytest.mark.parametrize(
    ("parts", "spread", "names", "sentence"),
    [
        (
            [NAMES[:9], NAMES[9:16]],
            [9, 7],
            NAMES,
            r"split 20 photographs into 2 models.*9 photographs \(00.jpg.*7 photographs \(09.jpg.*"
            f"add photographs between.*turned over.*{LOW}",
        ),
        ([], [], NAMES[:6], FEW.format(0)),
        ([NAMES[:2]], [2], NAMES[:6], FEW.format(2)),
        ([NAMES[:2], NAMES[2:4]], [2, 2], NAMES[:6], FEW.format(2)),
        (
            [NAMES],
            [0],
            NAMES,
            "registered 20 of 20 photographs, but only 0 of them see.*static background.*masks"
            ".*plain cloth.*move the camera",
        ),
    ],
)
def test_split_few_or_coincident_views_are_rejected(parts, spread, names, sentence):
    with pytest.raises(ReconstructionError, match=sentence):
        choose_component(parts, spread, names, 0.6)


def test_a_view_counts_if_enough_of_its_points_have_a_baseline(model):
    assert count_spread_views(model, 10) == 5
    assert count_spread_views(model, 41) == 0  # more than exist
    rotated = model.cam_from_world[:, :3, :3]
    behind = torch.tensor([0.0, 0.0, 4.0], dtype=torch.float64).expand(5, 3)
    one_place = rigid(rotated, (rotated @ behind[..., None])[..., 0])
    assert count_spread_views(model.replace(cam_from_world=one_place), 10) == 0
    # Four coincident views and one apart: only points of the latter have an angle.
    aside = one_place.clone()
    aside[4, :3, 3] += aside.new_tensor([2.0, 0.0, 0.0])
    alone = model.observation_view != 4
    assert count_spread_views(model.replace(cam_from_world=aside), 10) == 5
    assert count_spread_views(model.replace(cam_from_world=aside).without(~alone), 10) == 0
