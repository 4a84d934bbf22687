"""Guided matching of synthetic features and of two photographs."""

from importlib.resources import files

import numpy as np
import pytest
import torch
from torch.nn.functional import pad

from pimper_torch.geometry.colmap_library import loaded, quiet
from pimper_torch.io.photographs import load_views
from pimper_torch.stages.sfm.epipolar import sampson_errors
from pimper_torch.stages.sfm.features import find_features, workspace
from pimper_torch.stages.sfm.matching import (
    Features,
    Near,
    guided_matches,
    match_guided,
    match_pairs,
    most_similar,
    verified_pairs,
)
from pimper_torch.stages.sfm.reconstruct_config import ReconstructConfig

CONFIG = ReconstructConfig(threads=1)

# Cameras side by side: epipolar lines are rows.
ROWS = torch.tensor([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)
BESIDE = Near(ROWS, 2.0)


def features(pixels, descriptors):
    """Make features whose descriptors are angles about one axis, in degrees."""
    rotated = torch.deg2rad(torch.tensor(descriptors, dtype=torch.float64))
    return Features(
        pixels=torch.tensor(pixels, dtype=torch.float64),
        descriptors=torch.stack([rotated.cos(), rotated.sin()], dim=1).float(),
    )


ONE = [[5.0, 10.0]]
TWO = [[5.0, 10.0], [5.0, 60.0]]
RIVALS = features([[30.0, 11.0], [40.0, 9.0]], [10.0, 12.0])


@pytest.mark.parametrize(
    ("first", "second", "ratio", "found"),
    [
        # A similar feature off the line is no rival; on the line, 0 against 2 degrees is distinct.
        (
            features(TWO, [0.0, 90.0]),
            features([[30.0, 11], [40, 30], [30, 60], [40, 61.5]], [10.0, 0, 90, 92]),
            0.8,
            [[0, 0], [1, 2]],
        ),
        (features(TWO, [0.0, 90.0]), RIVALS, 0.8, []),
        (features(TWO, [0.0, 90.0]), RIVALS, 0.9, [[0, 0]]),
        # Mutual best.
        (features([[5.0, 10], [9, 10.5]], [0.0, 10]), features([[30.0, 10]], [2.0]), 0.8, [[0, 0]]),
        (features(ONE, [0.0]), features([[30.0, 10.0]], [45.0]), 0.8, []),  # unlike, no rivals
        (features([[5.0, 200.0]], [0.0]), features(TWO, [10.0, 0.0]), 0.8, []),  # none near
    ],
)
def test_matches_are_mutual_best_and_distinct_along_the_line(first, second, ratio, found):
    assert guided_matches(first, second, BESIDE, ratio).tolist() == found


def sampsons_distance(fundamental, first, second):
    ends = pad(first, (0, 1), value=1), pad(second, (0, 1), value=1)
    residual = ends[0] @ fundamental.mT @ ends[1].mT
    lines, back = ends[0] @ fundamental.mT, ends[1] @ fundamental
    slope = lines[:, None, :2].square().sum(dim=2) + back[None, :, :2].square().sum(dim=2)
    return residual.abs() / slope.sqrt()


def distance_from_mapped(homography, first, second):
    mapped = pad(first, (0, 1), value=1) @ homography.mT
    return (mapped[:, None, :2] / mapped[:, None, 2:] - second).norm(dim=2)


@pytest.mark.parametrize(("length", "planar"), [(128, False), (13, True)])
def test_the_two_largest_products_within_the_distance_are_found(generator, length, planar):
    def some(count):
        described = torch.rand(count, length, generator=generator)
        pixels = 200 * torch.rand(count, 2, generator=generator, dtype=torch.float64)
        return Features(pixels=pixels, descriptors=described / described.norm(dim=1, keepdim=True))

    first, second = some(300), some(200)
    if planar:
        matrix, limit = torch.tensor([[1.1, 0, 5], [0, 0.9, 0], [1e-4, 0, 1]]).double(), 20.0
    else:
        rotated = torch.tensor([[1e-6, -3e-6, 0.001], [2e-6, 1e-6, -0.01], [-0.002, 0.01, 0.05]])
        matrix, limit = rotated.double(), 5.0
    distance = distance_from_mapped if planar else sampsons_distance
    away = distance(matrix, first.pixels, second.pixels)
    assert ((away - limit).abs() > 1e-5 * limit).all()  # none within rounding of the limit
    products = first.descriptors @ second.descriptors.mT
    products = torch.where(away <= limit, products, -1)
    found = most_similar(first, second, Near(matrix, limit, planar=planar))
    for alike, table in zip(found, (products, products.mT), strict=True):
        largest, best = table.topk(2, dim=1)
        best = torch.where(largest[:, 0] >= 0, best[:, 0], -1)
        assert (best >= 0).sum() > 0.8 * len(best)  # most have candidates nearby
        assert (largest[:, 1] >= 0).sum() > 0.5 * len(best)
        assert torch.equal(alike[1], best)
        # Float32 sums of up to 128 products, of total size one, in a different order.
        torch.testing.assert_close(alike[0], largest, rtol=0, atol=length * 6e-8)


def test_guided_matching_adds_matches_near_epipolar_lines():
    views = load_views(str(files("pimper_torch").joinpath("data/skull")), max_size_px=400)
    views = views.take([views.names.index(name) for name in ("36.jpg", "37.jpg")])
    with workspace(views, 1) as space:
        find_features(space, CONFIG, [None, None], [0, 0])
        match_pairs(space, [(0, 1)], CONFIG)
        (plain,) = verified_pairs(space)
        match_guided(space, [(0, 1)], CONFIG)
        (guided,) = verified_pairs(space)
        with quiet(), loaded().Database.open(space.database) as stored:
            geometry = torch.from_numpy(np.array(stored.read_two_view_geometry(1, 2).F))
    assert guided.num_matches > 1.2 * plain.num_matches
    errors = sampson_errors(geometry, guided.first, guided.second)
    assert float(errors.max()) <= CONFIG.max_error_px * (1 + 1e-6)
