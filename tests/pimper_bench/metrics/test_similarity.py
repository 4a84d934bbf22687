import pytest
import torch
from torch.testing import assert_close

from pimper_bench.metrics import (
    pair_views,
    similarity_between_cameras,
    similarity_between_points,
)
from pimper_bench.scenes.scene_cameras import arc_cameras
from pimper_torch.geometry.rigid import rigid, transform
from pimper_torch.runtime.errors import InputError


def test_a_similarity_of_points_is_recovered(make, generator):
    rotation = make.rotation(generator)
    known = rigid(2.5 * rotation, torch.tensor([1.0, -2.0, 3.0], dtype=torch.float64))
    points = torch.randn(20, 3, generator=generator, dtype=torch.float64)
    assert_close(similarity_between_points(points, transform(known, points)), known)


def test_the_similarity_of_noisy_points_is_optimal(generator):
    points = torch.randn(30, 3, generator=generator, dtype=torch.float64)
    target = 1.5 * points + 0.3 * torch.randn(30, 3, generator=generator, dtype=torch.float64)
    best = similarity_between_points(points, target)

    def cost(matrix):
        return (transform(matrix, points) - target).square().sum()

    for _ in range(200):
        twist = 1e-3 * torch.randn(3, 3, generator=generator, dtype=torch.float64)
        change = torch.linalg.matrix_exp(twist - twist.mT)
        change = change * (1 + 1e-3 * torch.randn(1, generator=generator, dtype=torch.float64))
        shift = 1e-3 * torch.randn(3, generator=generator, dtype=torch.float64)
        assert cost(rigid(change, shift) @ best) > cost(best)


def test_mirrored_points_still_get_a_rotation(generator):
    points = torch.randn(20, 3, generator=generator, dtype=torch.float64)
    found = similarity_between_points(points, points * points.new_tensor([1, 1, -1]))
    assert torch.linalg.det(found[:3, :3]) > 0


@pytest.mark.parametrize("num_views", [2, 3, 12])
def test_a_similarity_of_cameras_on_an_arc_is_recovered_from_any_number(make, generator, num_views):
    truth = arc_cameras(num_views, width=64, height=48, focal_px=70.0, distance=4.0, sway_deg=0.0)
    rotation, shift = make.rotation(generator), torch.tensor([0.4, 5.0, -1.0]).double()
    known = rigid(0.2 * rotation, shift)
    ours = make.transferred(truth, 0.2, rotation, shift)
    found = similarity_between_cameras(ours, truth)
    assert_close(found @ known, torch.eye(4, dtype=torch.float64), atol=1e-10, rtol=0)


def _arc(count):
    return arc_cameras(count, width=64, height=48, focal_px=70.0, distance=4.0)


def _facing(centers, facing):
    return rigid(facing, -(facing @ centers[..., None])[..., 0])


def _mirrored(cameras):
    """Cameras with one viewing direction, and the same at mirrored positions."""
    facing = cameras.cam_from_world[:1, :3, :3].expand(5, 3, 3)
    centers = cameras.centers_world
    return (
        cameras.replace(cam_from_world=_facing(places, facing)) for places in (-centers, centers)
    )


@pytest.mark.parametrize(
    ("cameras", "message"),
    [
        (lambda: (_arc(2).take([0, 0]), _arc(2)), "scale is undetermined"),
        (lambda: _mirrored(_arc(5)), "do not correspond"),
        (lambda: (_arc(2), _arc(3)), "2 cameras and 3 true ones"),
    ],
)
def test_cameras_that_determine_no_similarity_are_refused(cameras, message):
    with pytest.raises(InputError, match=message):
        similarity_between_cameras(*cameras())


def test_views_are_paired_by_name():
    ours, truth = pair_views(["c", "a", "x"], ["a", "b", "c"])
    assert ours.tolist() == [0, 1]
    assert truth.tolist() == [2, 0]
    with pytest.raises(InputError, match="Use the same names for the photographs"):
        pair_views(["p"], ["q"])


def test_views_are_paired_without_folder_and_suffix():
    ours, truth = pair_views(["raw/07.tif", "08.png", "9.jpg"], ["08.png", "07.png", "9.png"])
    assert ours.tolist() == [0, 1, 2]
    assert truth.tolist() == [1, 0, 2]


def test_an_ambiguous_stem_pairs_no_views():
    ours, truth = pair_views(["a/1.png", "b/1.png", "c.png"], ["1.jpg", "c.png"])
    assert ours.tolist() == [2]
    assert truth.tolist() == [1]
    ours, truth = pair_views(["1.tif", "1.png"], ["1.png"])  # equal names take precedence
    assert ours.tolist() == [1]
