import math

import pytest
import torch
from scenes import ball as unit_ball
from torch.nn.functional import normalize
from torch.testing import assert_close

from pimper_bench.scenes.scene_cameras import turntable_directions
from pimper_torch.geometry.pinholes import look_at, pinholes
from pimper_torch.geometry.surfaces import face_normals
from pimper_torch.geometry.visibility import RayCaster
from pimper_torch.records import Cameras, CoarseMesh, Mesh
from pimper_torch.stages.patches.decompose import Decompose, views_facing
from pimper_torch.stages.patches.patches_config import DecomposeConfig
from pimper_torch.stages.patches.view_choice import selected_views, view_blocks, view_weights
from tests.threads import on_threads

FOCAL, DISTANCE, SPACING = 100.0, 4.0, 0.02


def cameras_at(eyes) -> Cameras:
    eyes = torch.as_tensor(eyes, dtype=torch.float64)
    up = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    return pinholes(look_at(eyes, torch.zeros_like(eyes[0]), up), FOCAL, 200, 200)


def square(z: float = 0.0, half: float = 0.1) -> Mesh:
    """Return two facets perpendicular to z that face it."""
    corners = torch.tensor([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * half
    vertices = corners.double() + torch.tensor([0, 0, z]).double()
    return Mesh(vertices_world=vertices, faces=torch.tensor([[0, 1, 2], [0, 2, 3]]))


def weights(mesh: Mesh, cameras: Cameras, hiding: Mesh | None = None) -> torch.Tensor:
    hiding = mesh if hiding is None else hiding
    vertices, faces = mesh.vertices_world, mesh.faces
    return view_weights(
        vertices[faces].mean(dim=1),
        face_normals(vertices, faces),
        cameras,
        torch.tensor(SPACING).double(),
        RayCaster(hiding.vertices_world, hiding.faces),
    )


@pytest.fixture(scope="module")
def ball() -> tuple[Mesh, Cameras]:
    """A ball, and 90 cameras around it at three elevations."""
    directions = [turntable_directions(30, elevation_deg=each) for each in (-35.0, 5.0, 45.0)]
    return unit_ball(), cameras_at(DISTANCE * torch.cat(directions))


def test_the_weight_of_a_view_is_the_projected_area_up_to_one_pixel():
    tilt = math.radians(50)
    eyes = [[0, 0, DISTANCE], [DISTANCE * math.sin(tilt), 0, DISTANCE * math.cos(tilt)], [0, 0, 1]]
    found = weights(square(half=1e-4), cameras_at(eyes))
    pixels = (SPACING * FOCAL / DISTANCE) ** 2
    expected = torch.tensor([pixels, pixels * math.cos(tilt), 1.0]).double()
    assert_close(found[0], expected, rtol=1e-4, atol=0)  # facet centres are off the axis by as much


def test_views_that_do_not_see_a_facet_have_weight_zero():
    hiding = square(z=1.0, half=0.5)
    away = cameras_at([[0, 0, -DISTANCE], [0, 0, DISTANCE], [DISTANCE, 0, DISTANCE]])
    shifted = away.intrinsics.clone()
    shifted[:, 0, 2] += 500
    aside = away.replace(intrinsics=shifted)
    assert weights(square(), away, hiding)[0].gt(0).tolist() == [False, False, True]
    assert not weights(square(), aside).any()
    assert weights(square(), away)[0].gt(0).tolist() == [False, True, True]


def some_weights(generator, facets=12, views=30):
    weight = torch.rand(facets, views, generator=generator, dtype=torch.float64)
    directions = torch.randn(views, 3, generator=generator, dtype=torch.float64)
    return weight * (weight > 0.4), normalize(directions, dim=1)


def test_few_views_are_all_chosen_unless_they_see_no_facet(generator):
    weight, directions = some_weights(generator)
    weight[:, 7] = 0
    assert selected_views(weight, directions, 40).logical_not().nonzero().tolist() == [[7]]
    assert selected_views(weight, directions, 5).sum() == 5
    assert selected_views(torch.zeros(3, 4), torch.eye(4)[:, :3], 2).sum() == 1  # at least one


def test_views_that_see_no_facet_do_not_affect_the_choice(generator):
    weight, directions = some_weights(generator)
    more = torch.cat([weight, torch.zeros(12, 9)], dim=1), torch.cat([directions, directions[:9]])
    found = selected_views(*more, 10)
    assert torch.equal(found[:30], selected_views(weight, directions, 10))
    assert not found[30:].any()


def test_the_choice_does_not_depend_on_the_order_of_views(generator):
    weight, directions = some_weights(generator)
    order = torch.randperm(30, generator=generator)
    found = selected_views(weight[:, order], directions[order], 10)
    assert torch.equal(found, selected_views(weight, directions, 10)[order])


def test_facets_share_the_views_evenly():
    weight = torch.zeros(2, 20, dtype=torch.float64)
    weight[0, :10], weight[1, 10:] = 0.9, 0.3
    circle = torch.arange(20) * math.pi / 10
    directions = torch.stack([circle.cos(), circle.sin(), 0 * circle], dim=1).double()
    chosen = selected_views(weight, directions, 10)
    seen = (weight * chosen).gt(0).sum(dim=1)
    assert seen.min() >= 3  # by weight alone, the second had none


def test_chosen_views_spread_and_alternate_among_poses():
    steps = torch.deg2rad(torch.linspace(-40, 40, 41, dtype=torch.float64))
    arc = torch.stack([steps.sin(), 0 * steps, -steps.cos()], dim=1)
    chosen = selected_views(steps.cos()[None], arc, 9)
    picked = torch.rad2deg(steps[chosen])
    assert picked.diff().min() >= 6  # 10 if evenly spaced, and 2 by weight alone
    poses = arc[::8].repeat_interleave(5, dim=0)  # six poses, each with five lights
    chosen = selected_views(torch.ones(1, 30), poses.float(), 12).reshape(6, 5)
    assert (chosen.sum(dim=1) == 2).all()
    assert chosen.any(dim=0).sum() >= 4  # not the first two lights of each


def test_blocks_contain_every_facet_once_with_most_of_its_views(ball):
    mesh, cameras = ball
    count = 12
    seen = weights(mesh, cameras) > 0
    blocks = view_blocks(mesh, cameras, torch.tensor(SPACING).double(), count)
    assert sorted(torch.cat([facets for facets, _ in blocks]).tolist()) == list(range(1280))
    shares = []
    for facets, views in blocks:
        assert 1 <= views.sum() <= count
        could = seen[facets].sum(dim=1).clamp_max(count)
        shares.append(seen[facets][:, views].sum(dim=1) / could)
    assert torch.cat(shares).mean() > 0.9
    assert torch.cat(shares).min() >= 0.5
    assert len(blocks) < 100


def test_blocks_do_not_depend_on_the_number_of_threads(ball):
    found = on_threads(lambda: view_blocks(*ball, torch.tensor(SPACING).double(), 12), 1, 2)
    for one, other in zip(*found, strict=True):
        assert torch.equal(one[0], other[0])
        assert torch.equal(one[1], other[1])


def test_views_are_chosen_only_if_more_than_num_views_face_a_facet(ball):
    mesh, cameras = ball
    coarse = CoarseMesh(mesh=mesh, reference=0, is_point=torch.ones(len(mesh.vertices_world)) > 0)
    most = int(views_facing(mesh.vertices_world, mesh.faces, cameras).max())
    every = Decompose(DecomposeConfig(num_views=most))(coarse, cameras)
    assert all(bucket.views is None for bucket in every.buckets)
    few = Decompose(DecomposeConfig(num_views=most // 2))(coarse, cameras)
    listed = torch.cat([bucket.facet for bucket in few.buckets])
    assert sorted(listed.tolist()) == list(range(len(mesh.faces)))
    for bucket in few.buckets:
        assert bucket.views is not None
        assert bucket.views.sum() <= most // 2
    one, other = (patches[17].buckets[0] for patches in (every, few))
    inside = [each.inside.sum() for each in (one, other)]
    assert torch.equal(*inside)


def test_photographs_beyond_num_views_do_not_coarsen_the_surface(ball):
    mesh, cameras = ball
    coarse = CoarseMesh(mesh=mesh, reference=0, is_point=torch.ones(len(mesh.vertices_world)) > 0)
    twice = Cameras.cat([cameras, cameras])
    asked = DecomposeConfig(num_views=10, max_samples=20_000.0)
    one, other = (Decompose(asked)(coarse, each) for each in (cameras, twice))
    every = Decompose(DecomposeConfig(max_samples=20_000.0, num_views=1000))(coarse, cameras)
    assert one.buckets[0].spacing[0] == other.buckets[0].spacing[0]
    assert one.buckets[0].spacing[0] < 0.7 * every.buckets[0].spacing[0]
