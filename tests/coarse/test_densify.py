import torch
from scenes import observing
from torch.nn.functional import normalize
from torch.testing import assert_close

from pimper_bench.scenes.procedural_meshes import icosphere, table
from pimper_bench.scenes.render_in_memory import Sphere, render_shape
from pimper_bench.scenes.scene_cameras import arc_cameras
from pimper_bench.scenes.true_clouds import sparse_scene
from pimper_torch.geometry.poisson import poisson_surface
from pimper_torch.geometry.projection import project
from pimper_torch.geometry.topology import connected_to
from pimper_torch.records import Support
from pimper_torch.stages.coarse.densify import (
    choose_sources,
    count_agreeing,
    push_pull,
    step_for_one_pixel,
)
from pimper_torch.stages.coarse.oriented import (
    OrientedPoints,
    grid_averaged,
    no_points,
    refit_normals,
    sparse_oriented,
)
from pimper_torch.stages.coarse.trim import (
    ViewCounts,
    near_points,
    supported_components,
    without_small_holes,
)
from pimper_torch.stages.coarse.window_matching import level_of, pair
from tests.coarse.ball import mottled


def ball(num_views=5):
    cameras = arc_cameras(
        num_views, width=160, height=120, focal_px=240.0, distance=4.0, sway_deg=0.0
    )
    lights = torch.tensor(
        [[0.2 + 0.05 * view, 0.1 * (view % 3 - 1), 0.05, 0.4] for view in range(num_views)]
    ).double()
    scene = render_shape(Sphere(), cameras, lights, mottled)
    return scene, sparse_scene(scene, 300, torch.Generator().manual_seed(0))


def test_holes_are_filled_and_the_rest_is_kept():
    generator = torch.Generator().manual_seed(0)
    values = torch.rand(13, 18, generator=generator) + 1
    known = torch.rand(13, 18, generator=generator) > 0.7
    filled = push_pull(values, known)
    assert_close(filled[known], values[known])
    assert filled.min() >= values[known].min() - 1e-6
    assert filled.max() <= values[known].max() + 1e-6
    even = push_pull(torch.full_like(values, 3.0), known)
    assert_close(even, torch.full_like(values, 3.0))


def test_noisy_points_share_larger_cells_but_sides_are_separate():
    points = torch.rand(4000, 3, generator=torch.Generator().manual_seed(0))
    points[:, 2] = 0.5
    up = torch.tensor([0.0, 0, 1]).expand(4000, 3)
    exact, noisy = torch.full((4000,), 1e-3), torch.full((4000,), 0.08)

    def count(noise, normals):
        cloud = OrientedPoints(points_world=points, normals_world=normals, noise=noise)
        return len(grid_averaged(cloud, 0.1).noise)

    assert 100 <= count(exact, up) <= 121
    assert count(noisy, up) < 0.2 * count(exact, up)
    both = torch.where(torch.arange(4000)[:, None] % 2 == 0, up, -up)
    assert 1.8 * count(exact, up) < count(exact, both) <= 2 * count(exact, up)


def test_only_small_holes_of_large_components_are_closed():
    vertices, faces = icosphere(3)
    centre = vertices[faces].mean(dim=1)
    kept = (centre[:, 2] < 0.6) & ~(centre[:, 0] > 0.95)
    whole = torch.ones(len(faces), dtype=torch.bool)
    assert (supported_components(vertices, faces, whole, 0.9)).all()
    repaired = without_small_holes(vertices, faces, kept, 1.0)
    assert repaired[centre[:, 0] > 0.95].all()  # 0.3 of the area unit
    assert not repaired[centre[:, 2] > 0.6].any()  # 2.5
    crumbs = (centre[:, 2] < 0) | (centre[:, 2] > 0.97)
    pieces = supported_components(vertices, faces[crumbs], whole[crumbs], 0.05)
    assert (pieces == (centre[crumbs][:, 2] < 0)).all()


def test_surface_near_points_is_kept_next_to_unsupported_surface():
    flat = table(half_side=72.0, cells=48)
    centre = flat.vertices_world[flat.faces].mean(dim=1)
    # Points everywhere except in two discs and a strip that joins them; a pixel is 1.
    wide = (centre[:, :2] - centre.new_tensor([-20.0, 0.0])).norm(dim=-1)
    narrow = (centre[:, :2] - centre.new_tensor([50.0, 0.0])).norm(dim=-1)
    strip = (centre[:, 0].abs() < 50) & (centre[:, 1].abs() < 6)
    empty = (wide < 48) | (narrow < 20) | strip
    cloud = OrientedPoints(
        points_world=centre[~empty],
        normals_world=torch.zeros_like(centre[~empty]),
        noise=torch.zeros_like(centre[~empty][:, 0]),
    )
    views = torch.full((len(centre),), 3)
    counts = ViewCounts(seen=views, lit=views, behind=0 * views)
    support = torch.where(empty, Support.LIGHT, Support.POINTS)
    kept = near_points(flat.faces, centre, cloud, support, counts, 1.0)
    assert not kept[wide < 36].any()  # 40 pixels from all points in the centre
    assert kept[narrow < 20].all()
    assert kept[~empty].all()
    connected = connected_to(flat.faces, empty, wide < 8)
    assert connected[narrow < 20].all()  # the strip joins them
    dark = counts.replace(lit=0 * views)
    assert (near_points(flat.faces, centre, cloud, support, dark, 1.0) == ~empty).all()


def test_a_view_agrees_only_with_views_of_the_same_surface():
    truth, scene = ball()
    level = level_of(scene, 1)
    depth = truth.depth.float()
    inverse_depth = torch.where(depth.isfinite(), 1 / depth, 0.0)
    good, others = depth.isfinite(), torch.tensor([1, 3])
    count = count_agreeing(level, inverse_depth, good, 2, others)
    inner = good[2] & (truth.normals_world[2][..., 2] > 0.7)
    assert float((count[inner] == 2).double().mean()) > 0.98
    assert not bool(count[~good[2]].any())
    wrong = inverse_depth.clone()
    wrong[3] *= 1.1
    count = count_agreeing(level, wrong, good, 2, others)
    assert float((count[inner] == 1).double().mean()) > 0.98


def test_poisson_surfaces_do_not_depend_on_previous_calls():
    vertices, _ = icosphere(4)
    vertices = vertices.float()

    def made(depth):
        return poisson_surface(vertices, vertices, depth=depth, point_weight=1.0)

    before = made(5)
    made(3)
    for one, other in zip(before, made(5), strict=True):
        assert torch.equal(one, other)


def test_sources_are_the_views_at_angles_that_match_well():
    _, scene = ball(9)  # 50 degrees in total: 6 between neighbours
    everyone = torch.arange(len(scene.points_world))
    found = choose_sources(scene, everyone, 4)
    rays = normalize(scene.cameras.centers_world, dim=1)
    angle = torch.rad2deg((rays @ rays[4]).clamp(-1, 1).acos())
    assert set(found[:2].tolist()) == {2, 6}  # 12 degrees, the best available angle
    assert bool((angle[found] < 20).all())
    assert 4 not in found.tolist()
    # Without shared points no view is a source.
    seen_by_4 = scene.observed[:, 4]
    alone = (scene.observation_view == 4) | ~seen_by_4[scene.observation_point]
    assert len(choose_sources(observing(scene, alone), everyone, 4)) == 0


def test_a_step_of_inverse_depth_moves_points_by_a_pixel():
    _, scene = ball()
    level = level_of(scene, 1)
    pairing = pair(level, 2, torch.tensor([1, 3]))
    here = scene.points_world[scene.observed[:, 2]]
    cameras = scene.cameras
    pixels, depth = project(here, cameras.cam_from_world[2], cameras.intrinsics[2])
    step = step_for_one_pixel(pairing, pixels, 1 / depth)
    center = cameras.centers_world[2]
    farther = center + (here - center) * (depth * (1 / depth - step)).reciprocal()[:, None]
    moved = []
    for view in (1, 3):
        camera = cameras.cam_from_world[view], cameras.intrinsics[view]
        moved.append((project(farther, *camera)[0] - project(here, *camera)[0]).norm(dim=1))
    assert abs(float(torch.cat(moved).median()) - 1) < 0.05  # looked up at whole pixels


def sheets(generator, gap=0.055):
    """Return two sheets that face away from each other, with noisy normals.

    About 21 of 24 neighbours are on the same sheet, fewer at its border.
    """
    points = torch.rand(4000, 3, generator=generator, dtype=torch.float64)
    up = torch.arange(4000)[:, None] % 2 == 0
    points[:, 2] = torch.where(up[:, 0], gap, 0.0)
    true = torch.where(up, 1.0, -1.0) * torch.tensor([0.0, 0, 1]).double()
    normals = normalize(true + 0.25 * torch.randn(4000, 3, generator=generator).double(), dim=1)
    noise = torch.full((4000,), 0.01, dtype=torch.float64)
    return true, OrientedPoints(points_world=points, normals_world=normals, noise=noise)


def test_normals_follow_neighbours_on_each_side_of_a_thin_wall():
    true, cloud = sheets(torch.Generator().manual_seed(4))
    found = refit_normals(cloud)
    # If more neighbours are on the other sheet, normals disagree and points are dropped.
    assert len(found.points_world) > 0.8 * len(cloud.points_world)
    truth = torch.where(found.points_world[:, 2:] > 0.02, 1.0, -1.0) * true[:1]
    cosine = (found.normals_world * truth).sum(dim=1)
    given = (cloud.normals_world * true).sum(dim=1)
    assert float((cosine > 0.999).double().mean()) > 0.95
    assert float((given > 0.999).double().mean()) < 0.05


def test_points_with_inconsistent_neighbour_normals_are_dropped():
    generator = torch.Generator().manual_seed(5)
    _, cloud = sheets(generator)
    random = normalize(torch.randn(4000, 3, generator=generator, dtype=torch.float64), dim=1)
    assert len(refit_normals(cloud.replace(normals_world=random)).noise) < 0.2 * 4000


def test_sparse_points_far_from_dense_ones_face_the_cameras():
    _, scene = ball()
    everyone = torch.arange(len(scene.points_world))
    found = sparse_oriented(scene, everyone, no_points(scene.points_world), 0.05)
    assert len(found.points_world) > 0.6 * len(everyone)
    cosine = (found.normals_world * normalize(found.points_world, dim=1)).sum(dim=1)
    assert float(cosine.min()) > 0.7
    assert float(cosine.median()) > 0.98
    # Half of the ball has dense points.
    half = found.points_world[:, 0] > 0
    left = sparse_oriented(scene, everyone, found.take(half), 0.05)
    assert float(left.points_world[:, 0].max()) < 0.05
    assert len(left.points_world) > 0.7 * int((~half).sum())
