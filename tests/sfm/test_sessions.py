from itertools import combinations

import pytest
import torch
from sparse_models import observed

from pimper_bench.scenes.whole_scene import upside_down
from pimper_torch.geometry.projection import project
from pimper_torch.geometry.rigid import transform
from pimper_torch.records import Cameras
from pimper_torch.runtime.errors import PimperWarning
from pimper_torch.stages.sfm.matching import VerifiedPair
from pimper_torch.stages.sfm.moved_object import sessions_in, with_sessions
from tests.sfm.moved import K, bodies, poses


def model_of(counts, generator, *, moved=True):
    """Return a model in the table's frame; points are seen by views within 50 degrees."""
    own, table = bodies(generator, num_object=400, num_table=400)
    cameras = torch.cat([poses(count) for count in counts])
    sessions = torch.arange(len(counts)).repeat_interleave(torch.tensor(counts))
    toward = -cameras[:, 2, :3]
    near = torch.nn.functional.normalize(toward[:, :2], dim=1)
    placed, seen = [table], [torch.ones(400, len(cameras), dtype=torch.bool)]
    for number in range(len(counts) if moved else 1):
        points = transform(upside_down(own), own) if number == 1 else own
        outward = torch.nn.functional.normalize(points[:, :2], dim=1)
        facing = outward @ near.mT > 0.64
        placed.append(points)
        seen.append(facing & (sessions == number) if moved else facing)
    sizes = torch.tensor([[320, 240]] * len(cameras))
    rig = Cameras(intrinsics=K.expand(len(cameras), 3, 3), cam_from_world=cameras, sizes_px=sizes)
    return observed(rig, torch.cat(placed), torch.cat(seen))


def test_sessions_follow_from_table_matches_under_the_cameras(generator):
    model = model_of((6, 6), generator)
    own, table = bodies(generator, num_object=400, num_table=80)
    pixels = project(table, model.cam_from_world, K.expand(12, 3, 3))[0]
    over = torch.eye(4).double().repeat(12, 1, 1)
    over[6:] = upside_down(own)
    model = model.replace(cam_from_world=model.cam_from_world @ over)  # in the object's frame
    pairs = [(a, b) for a, b in combinations(range(12), 2) if (b - a) % 6 < 2]
    around = [VerifiedPair(views=(a, b), first=pixels[a], second=pixels[b]) for a, b in pairs]
    assert sessions_in(model, model.names, around).tolist() == [0] * 6 + [1] * 6
    names = (*model.names[6:], "other.jpg", *model.names[:6])  # indices refer to all photographs
    moved = [
        one.replace(views=tuple(names.index(model.names[view]) for view in one.views))
        for one in around
    ]
    assert sessions_in(model, names, moved).tolist() == [0] * 6 + [1] * 6


def test_sessions_are_reported_and_views_of_tiny_ones_excluded(generator):
    model = model_of((12, 10), generator)
    with pytest.warns(PimperWarning, match=r"between 2 capture sessions.*12 \(0.png.*10 \(12.png"):
        noted = with_sessions(model, torch.tensor([0] * 12 + [1] * 10), model.names)
    assert noted.sessions.tolist() == [0] * 12 + [1] * 10
    with pytest.warns(PimperWarning, match=r"2 of 22 photographs .* 20.png, 21.png\. "):
        alone = with_sessions(model, torch.tensor([0] * 20 + [1] * 2), model.names)
    assert alone.num_views == 20
    assert len(alone.sessions) == 0
    with pytest.warns(PimperWarning, match="background shifts relative to the object.*--masks"):
        assert with_sessions(model, torch.arange(22), model.names) is model
