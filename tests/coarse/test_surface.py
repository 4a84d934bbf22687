import pytest
import torch
from scenes import ball, without_points
from torch.nn.functional import normalize
from torch.testing import assert_close

import pimper_torch as pt
from pimper_bench.scenes.procedural_meshes import icosphere, table
from pimper_bench.scenes.render_in_memory import Sphere, render_shape
from pimper_bench.scenes.scene_cameras import arc_cameras
from pimper_bench.scenes.true_clouds import sparse_scene
from pimper_torch.geometry.nearest import NearestSurface
from pimper_torch.geometry.surfaces import face_normals, vertex_normals
from pimper_torch.geometry.topology import face_components, face_pairs
from pimper_torch.records import Support
from pimper_torch.stages.coarse.surface import (
    limit_faces_per_edge,
    point_covariances,
    smoothed_normals,
)
from tests.coarse.ball import SETTINGS, photographed


def built(scene, mesh=None):
    """The coarse mesh of photographs without silhouettes."""
    contours = pt.Contours.none(pt.Silhouettes.everything(scene.views), scene.cameras)
    return pt.CoarseSurface(SETTINGS)(scene, contours, mesh)


@pytest.fixture(scope="module")
def whole(round_about):
    return built(round_about)


def test_views_from_all_sides_give_one_closed_surface(whole):
    mesh = whole.mesh
    pairs, _ = face_pairs(mesh.faces)
    assert 2 * len(pairs) == 3 * len(mesh.faces)  # every edge has two faces: no boundary
    assert int(face_components(mesh.faces).max()) == 0
    assert 500 <= len(mesh.faces) <= 600
    assert len(mesh.vertices_world) - len(pairs) + len(mesh.faces) == 2  # Euler: a ball


def test_the_surface_is_on_the_ball_and_faces_outward(whole):
    mesh = whole.mesh
    centre = mesh.vertices_world[mesh.faces].mean(dim=1)
    # A pixel is 1 / 60 of the radius; facets of a ball of 600 are up to 0.01 inside it.
    assert (centre.norm(dim=1) - 1).abs().mean() < 0.01
    assert (centre.norm(dim=1) - 1).abs().max() < 0.05
    outward = normalize(face_normals(mesh.vertices_world, mesh.faces), dim=-1)
    assert ((outward * normalize(centre, dim=-1)).sum(dim=-1) > 0.8).all()
    assert (mesh.normals_world * normalize(mesh.vertices_world, dim=-1)).sum(dim=-1).min() > 0.8


def test_facets_have_the_points_of_the_cloud(whole, round_about):
    points = whole.points
    assert len(points.facet) > 0.9 * len(round_about.points_world)
    corners = whole.mesh.vertices_world[whole.mesh.faces[points.facet]]
    reach = (corners - corners.mean(dim=1, keepdim=True)).norm(dim=-1).amax(dim=1)
    assert ((points.points_world - corners.mean(dim=1)).norm(dim=-1) < 1.2 * reach).all()
    assert points.covariance_world.shape == (len(points.facet), 3, 3)
    assert not whole.is_point.any()
    # A facet is 6 pixels wide, and a third of them have a point within 4.
    assert (whole.support == Support.POINTS).float().mean() > 0.3
    assert (whole.support >= Support.LIGHT).all()


def test_views_on_an_arc_give_the_visible_side():
    cameras = arc_cameras(6, width=120, height=100, focal_px=180.0, distance=4.0, sway_deg=4.0)
    scene = photographed(cameras)
    mesh = built(scene).mesh
    # Unseen surface is gone, and the black background has none.
    assert (mesh.vertices_world.norm(dim=1) - 1).abs().max() < 0.1
    assert mesh.vertices_world[:, 2].min() > -0.6
    # At least two views see 50 degrees up, down and to the sides.
    wanted = normalize(
        torch.tensor([[0.0, 0, 1], [0.6, 0, 0.8], [-0.6, 0, 0.8], [0, 0.7, 0.7], [0, -0.7, 0.7]]),
        dim=-1,
    )
    assert (NearestSurface(mesh).query(wanted).distance < 0.03).all()


def test_masks_exclude_the_background():
    cameras = arc_cameras(6, width=120, height=100, focal_px=180.0, distance=4.0, sway_deg=0.0)
    scene = photographed(cameras)
    masks = scene.views.inside.clone()
    masks[:, 50:] = False  # the lower half of the ball in every image
    mesh = built(scene.replace(views=scene.views.replace(masks=masks))).mesh
    assert mesh.vertices_world[:, 1].min() > -0.1  # y is up
    assert mesh.vertices_world[:, 1].max() > 0.6


def test_there_are_no_facets_below_the_supporting_plane(whole, round_about):
    plane = torch.tensor([0.0, 0.6, 0.8, -0.2])
    silhouettes = pt.Silhouettes.everything(round_about.views, plane[None])
    contours = pt.Contours.none(silhouettes, round_about.cameras)
    mesh = pt.CoarseSurface(SETTINGS)(round_about, contours).mesh
    side = 0.15  # of a facet
    height = mesh.vertices_world.double() @ plane[:3].double() + plane[3]
    assert -side < height.min() < side
    everywhere = whole.mesh.vertices_world.double()
    above = everywhere @ plane[:3].double() + plane[3] > side
    assert (
        NearestSurface(mesh).query(everywhere[above].to(mesh.vertices_world)).distance < 0.05
    ).all()


def test_a_given_mesh_is_oriented_to_the_cameras_and_simplified(round_about):
    whole = ball()
    coarse = built(round_about, whole.replace(faces=whole.faces.flip(1)))
    outward = face_normals(coarse.mesh.vertices_world, coarse.mesh.faces)
    centre = coarse.mesh.vertices_world[coarse.mesh.faces].mean(dim=1)
    assert ((outward * centre).sum(dim=-1) > 0).all()
    assert len(coarse.mesh.faces) <= 600 < len(whole.faces)
    assert (centre.norm(dim=1) - 1).abs().max() < 0.03
    assert len(coarse.points.facet) > 0.9 * len(round_about.points_world)


def test_a_small_given_mesh_is_unchanged(round_about):
    mesh = ball(level=1)
    assert mesh.vertices_world.dtype == torch.float64  # as read from files
    found = built(round_about, mesh).mesh
    assert found.vertices_world.dtype == round_about.cameras.intrinsics.dtype == torch.float32
    assert_close(found.vertices_world[found.faces], mesh.vertices_world.float()[mesh.faces])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda v, f: (v, f + len(v)), "faces range from 42 to 83"),
        (lambda v, f: (v / 0, f), "not finite"),
    ],
)
def test_an_unusable_mesh_is_rejected(round_about, change, message):
    vertices, faces = change(*icosphere(1))
    with pytest.raises(pt.InputError, match=message):
        built(round_about, pt.Mesh(vertices_world=vertices.float(), faces=faces))


def test_a_cloud_without_reliable_points_is_rejected(round_about):
    doubtful = round_about.replace(reprojection_errors_px=round_about.reprojection_errors_px + 100)
    with pytest.raises(pt.ReconstructionError, match="0 of"):
        built(doubtful)


def test_the_smallest_of_three_faces_at_an_edge_is_removed():
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 0.1]])
    faces = torch.tensor([[0, 1, 2], [1, 0, 4], [1, 0, 3]])
    assert limit_faces_per_edge(vertices, faces).tolist() == [[0, 1, 2], [1, 0, 3]]


def test_smoothing_normals_keeps_a_plane_and_halves_a_crease():
    line = torch.linspace(-1, 1, 3)
    y, x = torch.meshgrid(line, line, indexing="ij")
    flat = torch.stack([x, y, 0 * x], dim=-1).reshape(-1, 3)
    faces = table(1.0, cells=2).faces
    up = torch.tensor([0.0, 0.0, 1.0]).expand(9, 3)
    assert_close(smoothed_normals(flat, faces), up)
    # A roof along y: normals (-1, 0, 1), up and (1, 0, 1) rotate halfway to their neighbours.
    roof = flat - flat.new_tensor([0.0, 0.0, 1.0]) * flat[:, :1].abs()
    before, after = vertex_normals(roof, faces), smoothed_normals(roof, faces)
    tilt_before, tilt_after = (torch.atan2(one[3:6, 0], one[3:6, 2]) for one in (before, after))
    assert_close(tilt_before, torch.tensor([-1.0, 0.0, 1.0]) * torch.pi / 4)
    assert tilt_after[1].abs() < 1e-6
    ratio = tilt_after[[0, 2]] / tilt_before[[0, 2]]
    assert bool((ratio > 0.5).all() and (ratio < 0.8).all())
    assert_close(after.norm(dim=1), torch.ones(9))


def test_facets_of_a_mesh_are_its_faces_with_points_as_in_a_chain(round_about):
    vertices, faces = icosphere(2)
    mesh = pt.Mesh(vertices_world=vertices, faces=faces.flip(1))  # wound inwards
    found = pt.facets_of(mesh, round_about)
    assert len(found.mesh.faces) == len(faces)
    assert found.mesh.vertices_world.dtype == round_about.points_world.dtype
    outward = face_normals(found.mesh.vertices_world, found.mesh.faces)
    assert ((outward * found.mesh.vertices_world[found.mesh.faces].mean(dim=1)).sum(1) > 0).all()
    expected = built(round_about, mesh.replace(vertices_world=vertices.float()))
    assert found.reference == expected.reference
    assert_close(found.points.points_world, expected.points.points_world)
    assert_close(found.points.covariance_world, expected.points.covariance_world)
    bare = without_points(round_about)
    assert len(pt.facets_of(mesh, bare, round_about.views.names[3]).points.facet) == 0
    assert pt.facets_of(mesh, bare, round_about.views.names[3]).reference == 3


def test_facets_of_a_misplaced_mesh_are_rejected(round_about):
    with pytest.raises(pt.InputError, match="not where the photographs show the object"):
        pt.facets_of(ball(1000.0, level=2), round_about)


def noisy_cloud(noise_px, seed, span_deg=50.0):
    cameras = arc_cameras(
        6, width=160, height=120, focal_px=200.0, distance=4.0, sway_deg=0.0, span_deg=span_deg
    )
    lights = torch.tensor([[0.4, 0.0, 0.0, 0.4]], dtype=torch.float64).expand(6, 4)
    scene = render_shape(Sphere(), cameras, lights, lambda points: torch.ones_like(points))
    generator = torch.Generator().manual_seed(seed)
    return sparse_scene(scene, 1500, generator, noise_px=noise_px, dtype=torch.float64)


def test_covariances_match_the_errors_of_triangulated_points():
    noise = 0.3
    cloud = noisy_cloud(noise, 0)
    everyone = torch.arange(len(cloud.points_world))
    covariance = point_covariances(cloud, everyone)
    # The points came from a sphere: the radial error is known without knowing the point.
    radial = cloud.points_world / cloud.points_world.norm(dim=1, keepdim=True)
    predicted = torch.einsum("pi,pij,pj->p", radial, covariance, radial)
    error = cloud.points_world.norm(dim=1) - 1
    ratio = float((error.square() / predicted).mean())
    assert 0.6 < ratio < 1.6  # the triangulation is not weighted by depth, nor noise by track
    # Points with a larger predicted error have a larger one.
    order = predicted.argsort()
    half = len(order) // 2
    spread = [float(error[part].square().mean()) for part in (order[:half], order[half:])]
    assert spread[1] > 1.2 * spread[0]


def test_points_without_error_are_certain_and_all_covariances_are_symmetric():
    cloud = noisy_cloud(0.0, 2)
    covariance = point_covariances(cloud, torch.arange(20))
    assert covariance.abs().max() < 1e-6  # rounding of the depth maps
    noisy = point_covariances(noisy_cloud(0.3, 2), torch.arange(20))
    assert_close(noisy, noisy.mT)
    assert (torch.linalg.eigvalsh(noisy) > 0).all()
