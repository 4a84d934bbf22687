import pytest
import torch
from torch.testing import assert_close

from pimper_torch.geometry.visual_hull import margins, visual_hull
from tests.silhouettes import shapes
from tests.silhouettes.shapes import HEIGHT, WIDTH, silhouettes_of

BOX = torch.tensor([[-2.0, -2, -2], [2, 2, 2]])


@pytest.fixture(scope="module")
def cameras():
    return shapes.all_round().to(torch.float32)


def of_ball(cameras):
    return silhouettes_of(shapes.ball, cameras)


def hull_of(silhouettes, cameras, voxels=32, disagreeing=0.0, **options):
    """Return a hull and its volume."""
    options |= {"num_voxels": voxels**3, "disagreeing": disagreeing}
    hull = visual_hull(silhouettes, cameras, BOX, **options)
    assert hull is not None
    return hull, float(hull.occupied.sum() * hull.spacing**3)


@pytest.fixture(scope="module")
def ball(cameras):
    return hull_of(of_ball(cameras), cameras, 64)[0]


def test_the_hull_of_a_ball_contains_it_tightly(ball):
    steps = ball.occupied.nonzero()
    radius = (ball.origin_world + ball.spacing * steps).norm(dim=1)
    # The tangent cones of 20 views leave corners, at radii up to 1 / cos of half the angle
    # between neighbouring views (some 41 degrees).
    assert radius.max() < 1 / torch.deg2rad(torch.tensor(22.0)).cos() + ball.spacing
    volume = float(ball.occupied.sum() * ball.spacing**3)
    assert 4.189 * 0.99 < volume < 4.189 * 1.06  # 4/3 pi; a cube would have 1.9 times that


def test_depth_is_the_distance_to_the_border_along_every_radius(ball, generator):
    direction = torch.nn.functional.normalize(torch.randn(500, 3, generator=generator), dim=1)
    shells = torch.tensor([0.5, 0.9, 0.97])[:, None, None]
    depth = ball.depth_of(shells * direction)
    # A quarter of a pixel is 0.6 % of the radius; the hull is larger than the ball.
    assert_close(depth.amin(dim=1), 1 - shells[:, 0, 0], atol=0.02, rtol=0)
    assert (depth > 0).all()
    assert (ball.depth_of(1.15 * direction) < 0).all()


def test_off_the_grid_depth_falls_with_distance(ball):
    points = torch.tensor([[3.0, 0, 0], [4.0, 0, 0]])
    near, far = ball.depth_of(points)
    assert_close(near - far, torch.tensor(1.0))
    assert near < -1


def test_projections_of_the_hull_are_its_silhouettes(ball, cameras):
    drawn = of_ball(cameras).masks
    for view in (0, 7, 15):
        camera = cameras.intrinsics[view], cameras.cam_from_world[view]
        found = margins(ball, *camera, (WIDTH, HEIGHT)) > 0
        union = (found | drawn[view]).sum()
        assert (found & drawn[view]).sum() / union > 0.985  # half a pixel around is 2.5 %


def test_a_wrong_view_is_outvoted_or_excluded(cameras):
    silhouettes = of_ball(cameras)
    inside = silhouettes.inside.clone()
    inside[3] = 0
    wrong = silhouettes.replace(inside=inside)
    assert visual_hull(wrong, cameras, BOX, num_voxels=32**3, disagreeing=0.0) is None
    _, voted = hull_of(wrong, cameras, disagreeing=0.05)
    _, left_out = hull_of(wrong.replace(reliable=torch.arange(20) != 3), cameras)
    assert 4.1 < left_out < 4.6
    assert voted >= 0.99 * left_out  # inside with one vote less


@pytest.mark.parametrize(("doubt", "held"), [(0.3, True), (0.2, False)])
def test_votes_are_summed_and_a_tie_counts_as_object(cameras, doubt, held):
    """A tenth of 20 views may disagree: 5 views of weight 0.4 equal 2."""
    silhouettes = of_ball(cameras).replace(source="found")
    wrong = silhouettes.inside.clone()
    wrong[:10:2, :, WIDTH // 2 :] = doubt * (wrong[:10:2, :, WIDTH // 2 :] > 0)
    _, volume = hull_of(silhouettes.replace(inside=wrong), cameras, disagreeing=0.1)
    assert (volume > 4.0) == held


def test_separate_components_of_uncertain_silhouettes_are_excluded(cameras):
    """A second ball that no view shows and none excludes with certainty."""
    silhouettes = of_ball(cameras).replace(source="found")
    _, before = hull_of(silhouettes, cameras, disagreeing=0.1)
    other = silhouettes_of(lambda points: shapes.ball(3 * (points - 0.9)), cameras).inside
    inside = torch.maximum(silhouettes.inside, 0.48 * other)
    found, volume = hull_of(silhouettes.replace(inside=inside), cameras, disagreeing=0.1)
    assert found.depth_of(torch.full((3,), 0.9)) < 0
    assert 0.95 * before < volume < 1.2 * before


def test_views_abstain_at_unknown_pixels(cameras):
    silhouettes = of_ball(cameras)
    wrong = silhouettes.inside.clone()
    wrong[:9] = 0.5
    assert 4.1 < hull_of(silhouettes.replace(inside=wrong), cameras, 48)[1] < 4.8


def test_views_abstain_outside_their_photographs(cameras):
    """Photographs of half of the ball do not remove the other half."""
    silhouettes = of_ball(cameras)
    left = torch.tensor([[WIDTH // 2, HEIGHT]]).repeat(10, 1)
    sizes = torch.cat([left, cameras.sizes_px[10:]])
    inside = silhouettes.inside.clone()
    inside[:10, :, WIDTH // 2 :] = 0  # the padding
    cut = cameras.replace(sizes_px=sizes)
    _, volume = hull_of(silhouettes.replace(inside=inside), cut, 48, min_seen=0.4)
    assert 4.1 < volume < 4.8


def test_points_seen_by_too_few_views_are_outside(cameras):
    near = visual_hull(of_ball(cameras), cameras, BOX + 4.0, num_voxels=32**3)
    assert near is None  # the box is next to the ball
    everything = silhouettes_of(lambda points: points.norm(dim=-1) - 100.0, cameras)
    hull = visual_hull(everything, cameras, 4 * BOX, num_voxels=32**3, min_seen=0.9)
    assert hull is not None
    radius = (hull.origin_world + hull.spacing * hull.occupied.nonzero()).norm(dim=1)
    assert radius.max() < 2.5  # few views see beyond the image width at the origin, 2
