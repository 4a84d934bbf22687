"""Marks by a user, in photographs with barrel distortion."""

import pytest
import torch

from pimper_torch.geometry.lens_models import distort
from pimper_torch.geometry.rigid import transform
from pimper_torch.records import Silhouettes
from pimper_torch.runtime.errors import ConfigError, InputError
from pimper_torch.scale.find_scale import scale_of_bars, scale_of_cameras
from pimper_torch.scale.given import CameraDistance, Mark, PixelMark, ScaleBar
from pimper_torch.scale.marks import place_of


def direction(*values):
    vector = torch.tensor(values, dtype=torch.float64)
    return vector / vector.norm()


def pointer(result, view, point_world, digits=6):
    """Return the pixel of a point in a view's photograph before undistortion."""
    cameras = result.cameras.to(torch.float64)
    point_cam = transform(cameras.cam_from_world[view], point_world[None])
    x, y = distort(result.scene.lenses[view], point_cam)[0].tolist()
    return PixelMark(name=f"IMG_{view}", x=round(x, digits), y=round(y, digits))


def mark(result, point_world, *views, digits=6):
    return Mark(pointers=tuple(pointer(result, view, point_world, digits) for view in views))


@pytest.mark.parametrize("digits", [6, 0])
def test_two_marks_on_the_surface_give_the_scale(ball, digits):
    first, second = direction(-0.6, 0.4, 0.7), direction(0.5, 0.1, 0.8)
    true = float((first - second).norm())
    ends = mark(ball, first, 2, digits=digits), mark(ball, second, 3, digits=digits)
    bar = ScaleBar(first=ends[0], second=ends[1], length=1000 * true)
    scale = scale_of_bars(ball, [bar])
    # Whole pixels are off by 0.5 of 220.
    assert scale.factor == pytest.approx(1000, rel=5e-3 if digits == 0 else 5e-4)
    assert (scale.unit, scale.count) == ("mm", 1)


def test_a_mark_is_undistorted_and_intersected_with_the_surface(ball):
    wanted = direction(-0.6, 0.5, 0.6)
    found = place_of(mark(ball, wanted, 1), ball)
    # An icosphere of 20,480 faces is 3e-4 inside; without undistortion the error is 0.02.
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-3)


def test_a_mark_in_two_photographs_is_triangulated(ball):
    wanted = torch.tensor([0.7, 0.6, 1.2], dtype=torch.float64)
    found = place_of(mark(ball, wanted, 0, 4), ball)
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-5)


def test_a_mark_at_the_contour_is_on_the_object_and_not_on_the_table(ball):
    """A mesh ends slightly inside the contour: a mark just outside is snapped to it."""
    plane = torch.tensor([0.0, 1.0, 0.0, 1.0])  # y = -1 and above
    ball = ball.replace(silhouettes=Silhouettes.everything(ball.scene.views, plane[None]))
    eye = ball.cameras.to(torch.float64).centers_world[2]
    toward = eye / eye.norm()
    down = torch.linalg.cross(direction(1, 0, 0), toward)
    down = -down if down[1] > 0 else down
    # The contour: rays from the eye that touch the ball.
    touching = toward / eye.norm() + down * (1 - 1 / eye.norm() ** 2).sqrt()
    touched = pointer(ball, 2, touching)
    beside = Mark(pointers=(PixelMark(name="IMG_2", x=touched.x, y=touched.y + 1.0),))
    assert float((place_of(beside, ball) - touching).norm()) < 0.05
    far = Mark(pointers=(PixelMark(name="IMG_2", x=touched.x, y=touched.y + 40.0),))
    assert float(place_of(far, ball)[1]) == pytest.approx(-1, abs=1e-5)  # on the table


def test_a_mark_next_to_the_object_is_on_the_supporting_plane(ball):
    generator = torch.Generator().manual_seed(5)
    flat = 6 * torch.rand(200, 3, generator=generator) - 3
    flat[:, 1] = -1.0
    count = len(flat)
    scene = ball.scene.replace(
        points_world=flat,
        reprojection_errors_px=torch.zeros(count),
        observation_point=torch.arange(count).repeat(5),
        observation_view=torch.arange(5).repeat_interleave(count),
        observation_pixels=torch.zeros(5 * count, 2),
    )
    ball = ball.replace(scene=scene)
    ends = [torch.tensor([x, -1.0, 0.3], dtype=torch.float64) for x in (-1.3, 1.2)]
    for end in ends:
        torch.testing.assert_close(place_of(mark(ball, end, 2), ball), end, rtol=0, atol=1e-4)


def test_a_mark_inside_the_silhouette_is_not_on_the_table(ball):
    plane = torch.tensor([0.0, 1.0, 0.0, 1.0])
    inside = torch.ones(5, 480, 640)
    silhouettes = Silhouettes(
        inside=inside, reliable=torch.ones(5) > 0, source="masks", planes_world=plane[None]
    )
    place = Mark.read("IMG_2,320,470")
    with pytest.raises(InputError, match=r"IMG_2,320,470: this pixel is in the silhouette, but"):
        place_of(place, ball.replace(silhouettes=silhouettes))


def test_a_mark_does_not_hit_back_faces(ball):
    mesh = ball.mesh
    front = mesh.vertices_world[mesh.faces].mean(dim=1)[:, 2] > 0
    halved = ball.replace(mesh=mesh.replace(faces=mesh.faces[~front]))
    with pytest.raises(InputError, match="goes through an opening of the surface"):
        place_of(Mark.read("IMG_2,320,240"), halved)


def test_a_mark_on_uncertain_surface_gives_a_warning(ball):
    low = ball.mesh.replace(confidence=torch.full((len(ball.mesh.vertices_world),), 0.3))
    with pytest.warns(UserWarning, match=r"hardly determine the surface there: .* is 0\.30"):
        place_of(Mark.read("IMG_2,320,240"), ball.replace(mesh=low))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("IMG_7,3,4", "'IMG_7': no photographs have this name; needed: one of IMG_0.jpg"),
        ("IMG_9.jpg,3,4", "IMG_9.jpg: this photograph has no camera; needed: a registered"),
        ("IMG_1,640.5,4", "IMG_1,640.5,4: is outside the photograph, which has 640 x 480"),
        ("IMG_1,3,4", "IMG_1,3,4: the ray of this pixel misses the surface, and the supporting"),
        (
            "IMG_1,3,4+IMG_1,3,4",
            "IMG_1,3,4: the rays of these pixels differ by .* needed: at least 1",
        ),
        ("IMG_0,300,200+IMG_4,300,400", r"IMG_0,300,200 is \d+ pixels from the point that"),
    ],
)
def test_a_mark_that_cannot_be_located_is_named(ball, text, message):
    with pytest.raises(InputError, match=message):
        place_of(Mark.read(text), ball)


@pytest.mark.parametrize("text", ["", "a", "a,1", "a,1,b", ",1,2", "a,1,2+", "a,nan,2"])
def test_invalid_marks_are_refused(text):
    with pytest.raises(InputError, match="is not a pixel of a photograph; needed: NAME,x,y"):
        Mark.read(text)


def test_two_equal_marks_have_no_length(ball):
    end = mark(ball, direction(0, 0, 1), 2)
    with pytest.raises(InputError, match="is 0 in the result, and 5 mm is given; needed: two"):
        scale_of_bars(ball, [ScaleBar(first=end, second=end, length=5.0)])
    with pytest.raises(ConfigError, match=r"length of .* is -1"):
        ScaleBar(first=end, second=end, length=-1.0)


def distances(result, factor, pairs):
    centers = result.cameras.to(torch.float64).centers_world
    return [
        CameraDistance(
            first=f"IMG_{one}",
            second=f"IMG_{other}.jpg",
            length=factor * float((centers[one] - centers[other]).norm()),
        )
        for one, other in pairs
    ]


def test_camera_distances_give_the_exact_scale(ball):
    scale = scale_of_cameras(ball, distances(ball, 123.0, [(0, 4), (1, 2), (2, 3)]), "cm")
    assert scale.factor == pytest.approx(123, rel=1e-6)
    assert scale.residual < 1e-6
    assert scale.unit == "cm"


def test_the_factor_is_the_least_squares_solution(ball):
    given = distances(ball, 100.0, [(0, 4), (1, 2)])
    given = [given[0], CameraDistance(first="IMG_1", second="IMG_2", length=1.01 * given[1].length)]
    found = torch.tensor([one.length for one in distances(ball, 1.0, [(0, 4), (1, 2)])])
    known = torch.tensor([one.length for one in given])
    wanted = torch.linalg.lstsq(found[:, None], known[:, None], driver="gelsd").solution
    assert scale_of_cameras(ball, given).factor == pytest.approx(float(wanted), rel=1e-5)


def test_inconsistent_distances_are_named_with_their_residuals(ball):
    given = distances(ball, 100.0, [(0, 4), (1, 2), (2, 3)])
    wrong = CameraDistance(first="IMG_1", second="IMG_2", length=1.2 * given[1].length)
    with pytest.warns(UserWarning, match=r"camera distances contradict.*IMG_1 to IMG_2 is .*\(-1"):
        scale_of_cameras(ball, [given[0], wrong, given[2]])
