import pytest
import torch

from pimper_torch.geometry.projection import project
from pimper_torch.geometry.rigid import transform
from pimper_torch.stages.sfm.epipolar import fundamental_matrix, sampson_errors, shared_geometry
from pimper_torch.stages.sfm.matching import match_ends
from pimper_torch.stages.sfm.static_background import moving_matches
from tests.sfm.captured import Captured, orbit, seen_of_ball, turntable


# The violating fraction is smaller the closer the camera is to the plane of the table: all points
# move sideways, as under a camera that only shifts.
@pytest.mark.parametrize(("elevation_deg", "fraction"), [(2.0, 0.2), (25.0, 0.7)])
def test_the_background_is_static_and_the_turning_object_is_not(elevation_deg, fraction, generator):
    scene = turntable(generator, elevation_deg=elevation_deg)
    rest = scene.rest()
    assert rest.detected
    assert not rest.nothing_moves
    assert rest.moving_pairs >= 12
    assert rest.violating_fraction > fraction
    for thing, resting in zip(scene.thing, rest.features, strict=True):
        assert resting[thing < 500].double().mean() < 0.01
        assert resting[thing >= 500].double().mean() > 0.99
    kept = right = 0
    for pair, rows in scene.pairs.items():
        moving = moving_matches(scene.keypoints, pair, rows, rest)
        of_room = scene.thing[pair[0]][rows[:, 0]] >= 500
        true = scene.right(pair, rows)
        assert not (moving & of_room & true).any()
        kept, right = kept + int((moving & true).sum()), right + int((~of_room & true).sum())
    assert kept > 0.98 * right > 1000


def test_distant_points_under_a_shifting_camera_are_not_background(generator):
    cameras = orbit(8, 330.0)
    shift = torch.linspace(-1, 1, 8, dtype=torch.float64)
    poses = cameras.cam_from_world[:1].repeat(8, 1, 1)
    poses[:, 0, 3] += shift
    cameras = cameras.replace(cam_from_world=poses)
    far = torch.randn(300, 3, generator=generator, dtype=torch.float64) * 400
    far = transform(torch.linalg.inv(poses[0]), far.abs() + far.new_tensor([-500, -400, 6000.0]))
    near = seen_of_ball(generator, 600, cameras)
    far, _ = project(far, cameras.cam_from_world, cameras.intrinsics)
    scene = Captured(generator, torch.cat([near, far], dim=1))
    ends = [match_ends(scene.keypoints, pair, rows) for pair, rows in scene.pairs.items()]
    still = [((first - second).norm(dim=1) < 1).sum() for first, second in ends]
    assert min(still) > 100  # the distant ones are static
    rest = scene.rest()
    assert rest.moving_pairs == 24  # all that are verified first, which ends the search
    assert rest.violating_fraction < 0.01
    assert not rest.detected
    assert not any(resting.any() for resting in rest.features)


def test_a_flat_object_that_hardly_moves_keeps_its_features(generator):
    cameras = orbit(12, 18.0)
    points = torch.rand(500, 3, generator=generator, dtype=torch.float64) - 0.5
    points = points * points.new_tensor([4.0, 0.1, 3.0])
    points[:100, 1] *= 12
    pixels, _ = project(points, cameras.cam_from_world, cameras.intrinsics)
    scene = Captured(generator, pixels)
    rest = scene.rest()
    assert rest.moving_pairs > 10  # of the 24 that are verified first
    assert rest.static_fraction > 0.05
    assert rest.violating_fraction < 0.01
    assert not rest.detected


def test_duplicate_photographs_have_no_static_background(generator):
    cameras = orbit(6, 90.0)
    once = seen_of_ball(generator, 400, cameras)
    scene = Captured(generator, once.repeat_interleave(3, dim=0))
    assert scene.rest().static_fraction > 0.1
    rest = scene.rest()
    assert not rest.detected
    assert not rest.nothing_moves
    assert not any(resting.any() for resting in rest.features)


@pytest.mark.parametrize("shaken", [0, 100])
def test_a_static_scene_has_no_motion_despite_noisy_features(generator, shaken):
    detected = torch.rand(300, 2, generator=generator, dtype=torch.float64) * 400
    detected = detected.repeat(5, 1, 1)
    noise = torch.randn(5, shaken, 2, generator=generator, dtype=torch.float64)
    detected[:, :shaken] += 1.2 * noise
    rest = Captured(generator, detected).rest()
    assert rest.nothing_moves
    assert not rest.detected
    assert rest.moving_pairs == 0


def test_a_shared_geometry_is_found_only_for_consistent_matches(generator):
    cameras = orbit(2, 20.0)
    pixels = seen_of_ball(generator, 400, cameras)
    first, second = pixels[:, pixels.isfinite().all(dim=-1).all(dim=0)]
    near = (first - second).norm(dim=1) < 10
    ends = (first[near], second[near]), (first[~near], second[~near])
    assert sampson_errors(shared_geometry(*ends, 2.0), first, second).max() < 1e-4
    resting = torch.rand(100, 2, generator=generator, dtype=torch.float64) * 400
    geometry = shared_geometry((resting, resting), (first, second), 2.0)
    assert (sampson_errors(geometry, first, second) > 2).double().mean() > 0.5


def test_the_error_of_a_match_is_its_distance_to_a_consistent_one(generator):
    cameras = orbit(2, 20.0)
    points = torch.randn(30, 3, generator=generator, dtype=torch.float64)
    pixels, _ = project(points, cameras.cam_from_world, cameras.intrinsics)
    geometry = fundamental_matrix(pixels[0], pixels[1], torch.ones(30).double())
    assert sampson_errors(geometry, pixels[0], pixels[1]).max() < 1e-6
    line = torch.nn.functional.pad(pixels[0], (0, 1), value=1.0) @ geometry.mT
    across = line[:, :2] / line[:, :2].norm(dim=1, keepdim=True)
    shifted = pixels[1] + 3 * across
    # Both photographs share the correction: about 3 / sqrt(2) for lines of equal slope.
    found = sampson_errors(geometry, pixels[0], shifted)
    assert ((found > 1.9) & (found < 2.4)).all()
    along = torch.stack([-across[:, 1], across[:, 0]], dim=1)
    assert sampson_errors(geometry, pixels[0], pixels[1] + 9 * along).max() < 1e-6
