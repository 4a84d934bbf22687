import pytest
import torch
from scenes import from_above, tilted_square
from torch.testing import assert_close

from pimper_torch.geometry.projection import project
from pimper_torch.records import Mesh
from pimper_torch.viz.render import crop_to, image_bounds, orbit, shade


@pytest.fixture
def front():
    return from_above(40.0, 32, 24)


def test_the_light_comes_from_the_upper_left(front):
    def tone(mesh):
        return shade(mesh, front)[12, 16, 0]

    # The right side is nearer to the viewer: the face looks to the left.
    assert tone(tilted_square(x=0.4)) > tone(tilted_square()) > tone(tilted_square(x=-0.4))
    assert tone(tilted_square(y=-0.4)) > tone(tilted_square()) > tone(tilted_square(y=0.4))


def test_shading_ignores_the_given_normals(front):
    flat = tilted_square()
    bumpy = flat.replace(normals_world=torch.eye(4, 3) + 0.1)
    assert torch.equal(shade(bumpy, front), shade(flat, front))


def test_back_faces_are_bluish_and_the_background_is_white(front):
    behind = tilted_square().replace(faces=tilted_square().faces.flip(1))
    red, _, blue = shade(behind, front)[12, 16]
    assert blue > red + 0.1
    assert (shade(behind, front)[0, 0] == 1).all()
    assert_close(shade(tilted_square(), front)[12, 16, 0], shade(tilted_square(), front)[12, 16, 2])


def test_flat_shading_shows_edges_that_smooth_shading_hides(front):
    corners = torch.tensor(
        [[-1.0, -1, 0], [0, -1, 0.5], [0, 1, 0.5], [-1, 1, 0], [1, -1, 0], [1, 1, 0]]
    )
    roof = Mesh(
        vertices_world=corners, faces=torch.tensor([[0, 1, 2], [0, 2, 3], [1, 4, 5], [1, 5, 2]])
    )
    flat, smooth = (shade(roof, front, flat=flat)[12, 8:24, 0] for flat in (True, False))
    assert flat.diff().abs().max() > 3 * smooth.diff().abs().max()


def test_a_camera_moved_to_the_right_shows_the_right_side_and_keeps_the_centre(front):
    center = torch.tensor([0.2, 0.1, -0.3])
    rotated = orbit(front, center, 40.0)
    before, depth_before = project(center[None], front.cam_from_world[0], front.intrinsics[0])
    after, depth_after = project(center[None], rotated.cam_from_world[0], front.intrinsics[0])
    assert_close(after, before, rtol=0, atol=1e-4)
    assert_close(depth_after, depth_before)
    assert rotated.centers_world[0, 0] > front.centers_world[0, 0] + 1
    assert_close(rotated.centers_world[0, 1], front.centers_world[0, 1])
    assert_close(orbit(rotated, center, -40.0).cam_from_world, front.cam_from_world)


def test_a_frame_contains_the_points_at_the_given_size(front):
    points = torch.tensor([[-1.0, 0.5, 0], [0.5, -0.2, 0.3], [0, 0, 9.0]])  # the last one is behind
    framed = crop_to(front, points, longer_side_px=200, margin=0.1)
    pixels, _ = project(points[:2], framed.cam_from_world[0], framed.intrinsics[0])
    width, height = framed.sizes_px[0].tolist()
    assert max(width, height) == 200
    # A margin of a tenth on either side leaves ten twelfths for the box.
    assert_close(pixels[:, 0].min(), torch.tensor(200 / 12), rtol=0, atol=0.5)
    assert_close(pixels[:, 0].max(), torch.tensor(200 * 11 / 12), rtol=0, atol=0.5)
    low, high = image_bounds(front, points, 0.0)
    assert_close(low, project(points[:2], front.cam_from_world[0], front.intrinsics[0])[0].amin(0))
    assert (high > low).all()
