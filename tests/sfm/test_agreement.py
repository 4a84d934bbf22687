"""Views that are inconsistent with the pairs that have most matches."""

import pytest
import torch

from pimper_torch.geometry.lens_models import distort
from pimper_torch.geometry.rigid import rigid, transform
from pimper_torch.records.sparse_model import select_views
from pimper_torch.stages.sfm.diagnose import agreement, verify_model
from pimper_torch.stages.sfm.matching import VerifiedPair, all_pairs
from tests.sfm import ball


def bent(model):
    """Give the cameras of a model lens distortion."""
    lens = model.lenses[0].replace(params=(*model.lenses[0].params[:3], 0.3))
    return model.replace(lenses=(lens,) * model.num_views)


def pairs_of(model, points, counts=None):
    """Match points exactly; ``counts`` of them in some pairs, all in the others."""
    views = zip(model.lenses, model.cam_from_world, strict=True)
    pixels = [distort(lens, transform(frame, points)) for lens, frame in views]
    found = []
    for first, second in all_pairs(model.num_views):
        count = (counts or {}).get((first, second), len(points))
        ends = pixels[first][:count], pixels[second][:count]
        found.append(VerifiedPair(views=(first, second), first=ends[0], second=ends[1]))
    return found


def scene(generator):
    points = ball.points_on_the_ball(60, generator)
    model = bent(ball.model_of(ball.cameras_on_an_arc(), points, generator, noise_px=0.0))
    return model, points


def rotated(model, view, angle=0.6):
    """Move a view along the arc, still aimed at the ball."""
    rotation = torch.zeros(3, 3, dtype=torch.float64)
    rotation[0, 2], rotation[2, 0] = angle, -angle
    moved = rigid(torch.linalg.matrix_exp(rotation)[None], torch.zeros(1, 3).double())[0]
    poses = model.cam_from_world.clone()
    poses[view] = poses[view] @ moved
    return model.replace(cam_from_world=poses)


def test_a_misplaced_view_is_identified(generator):
    model, points = scene(generator)
    pairs = pairs_of(model, points)
    found = verify_model(rotated(model, 3), model.names, pairs, 4.0)[1]
    judges = [agreement(rotated(model, 3), pair, 4.0) for pair in pairs if 3 in pair.views]
    assert found.keys() == {"3.png"}
    assert min(judges) <= found["3.png"] <= max(judges) < 0.5


def test_the_inlier_ratio_counts_matches_of_missing_photographs_as_outliers(generator):
    model, points = scene(generator)
    pairs = pairs_of(model, points)
    counts = torch.tensor([pair.num_matches for pair in pairs]).double()
    assert verify_model(model, model.names, pairs, 0.01) == (1, {})  # with lens distortion
    wrong = rotated(model, 3)
    fractions = torch.tensor([agreement(wrong, pair, 4.0) for pair in pairs]).double()
    inlier_ratio = verify_model(wrong, model.names, pairs, 4.0)[0]
    assert inlier_ratio == pytest.approx(float((counts * fractions).sum() / counts.sum()))
    views = [0, 1, 2, *range(4, model.num_views)]
    there = torch.tensor([3 not in pair.views for pair in pairs])
    inlier_ratio = verify_model(select_views(model, views), model.names, pairs, 0.01)[0]
    assert inlier_ratio == pytest.approx(float(counts[there].sum() / counts.sum()))
    assert verify_model(model, model.names, [], 4.0)[0] == 0


def test_pairs_with_few_matches_do_not_count(generator):
    model, points = scene(generator)
    pairs = [
        pair.replace(first=pair.first.flip(0)) if pair.views in ((0, 4), (0, 5)) else pair
        for pair in pairs_of(model, points, {(0, 4): 20, (0, 5): 20})
    ]
    assert agreement(model, pairs[4], 4.0) < 0.5
    assert verify_model(model, model.names, pairs, 4.0)[1] == {}


def test_photographs_missing_from_the_model_do_not_count(generator):
    model, points = scene(generator)
    files = ("x.png", *model.names)
    pairs = [
        pair.replace(views=(pair.views[0] + 1, pair.views[1] + 1))
        for pair in pairs_of(model, points)
    ]
    stray = pairs[0].replace(views=(0, 1), first=pairs[0].first.flip(0))
    assert verify_model(model, files, [stray, *pairs], 4.0)[1] == {}
    assert verify_model(rotated(model, 5), files, [stray, *pairs], 4.0)[1].keys() == {"5.png"}
