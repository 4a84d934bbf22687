import pytest
import torch
from scenes import without_points
from torch.nn.functional import normalize
from torch.testing import assert_close

from pimper_bench.scenes.procedural_meshes import icosphere
from pimper_bench.scenes.scene_cameras import arc_cameras
from pimper_torch.geometry.contours import Contours
from pimper_torch.geometry.nearest import NearestSurface
from pimper_torch.geometry.surfaces import face_normals, vertex_normals
from pimper_torch.geometry.topology import face_components, face_pairs
from pimper_torch.records import Mesh, Silhouettes, Support
from pimper_torch.runtime.errors import InputError, ReconstructionError
from pimper_torch.stages.coarse.surface import (
    CoarseSurface,
    facets_of,
    limit_faces_per_edge,
    smoothed_normals,
)
from tests.coarse.ball import SETTINGS, photographed


def built(scene, mesh=None):
    """The coarse mesh of photographs without silhouettes."""
    contours = Contours.none(Silhouettes.everything(scene.views), scene.cameras)
    return CoarseSurface(SETTINGS)(scene, contours, mesh)


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
    silhouettes = Silhouettes.everything(round_about.views, plane[None])
    contours = Contours.none(silhouettes, round_about.cameras)
    mesh = CoarseSurface(SETTINGS)(round_about, contours).mesh
    side = 0.15  # of a facet
    height = mesh.vertices_world.double() @ plane[:3].double() + plane[3]
    assert -side < height.min() < side
    everywhere = whole.mesh.vertices_world.double()
    above = everywhere @ plane[:3].double() + plane[3] > side
    assert (
        NearestSurface(mesh).query(everywhere[above].to(mesh.vertices_world)).distance < 0.05
    ).all()


def test_a_given_mesh_is_oriented_to_the_cameras_and_simplified(round_about):
    vertices, faces = icosphere(3)
    inside_out = Mesh(vertices_world=vertices, faces=faces.flip(1))
    coarse = built(round_about, inside_out)
    outward = face_normals(coarse.mesh.vertices_world, coarse.mesh.faces)
    centre = coarse.mesh.vertices_world[coarse.mesh.faces].mean(dim=1)
    assert ((outward * centre).sum(dim=-1) > 0).all()
    assert len(coarse.mesh.faces) <= 600 < len(faces)
    assert (centre.norm(dim=1) - 1).abs().max() < 0.03
    assert len(coarse.points.facet) > 0.9 * len(round_about.points_world)


def test_a_small_given_mesh_is_unchanged(round_about):
    vertices, faces = icosphere(1)
    assert vertices.dtype == torch.float64  # as read from files
    coarse = built(round_about, Mesh(vertices_world=vertices, faces=faces))
    assert coarse.mesh.vertices_world.dtype == round_about.cameras.intrinsics.dtype == torch.float32
    assert_close(coarse.mesh.vertices_world[coarse.mesh.faces], vertices.float()[faces])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda v, f: (v, f + len(v)), "faces range from 42 to 83"),
        (lambda v, f: (v / 0, f), "not finite"),
    ],
)
def test_an_unusable_mesh_is_rejected(round_about, change, message):
    vertices, faces = change(*icosphere(1))
    with pytest.raises(InputError, match=message):
        built(round_about, Mesh(vertices_world=vertices.float(), faces=faces))


def test_a_cloud_without_reliable_points_is_rejected(round_about):
    doubtful = round_about.replace(reprojection_errors_px=round_about.reprojection_errors_px + 100)
    with pytest.raises(ReconstructionError, match="0 of"):
        built(doubtful)


def test_the_smallest_of_three_faces_at_an_edge_is_removed():
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 0.1]])
    faces = torch.tensor([[0, 1, 2], [1, 0, 4], [1, 0, 3]])
    assert limit_faces_per_edge(vertices, faces).tolist() == [[0, 1, 2], [1, 0, 3]]


def test_smoothing_normals_keeps_a_plane_and_halves_a_crease():
    line = torch.linspace(-1, 1, 3)
    y, x = torch.meshgrid(line, line, indexing="ij")
    flat = torch.stack([x, y, 0 * x], dim=-1).reshape(-1, 3)
    corner = torch.tensor([0, 1, 3, 4])
    faces = torch.cat(
        [
            torch.stack([corner, corner + 1, corner + 4], dim=1),
            torch.stack([corner, corner + 4, corner + 3], dim=1),
        ]
    )
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
    mesh = Mesh(vertices_world=vertices, faces=faces.flip(1))  # wound inwards
    found = facets_of(mesh, round_about)
    assert len(found.mesh.faces) == len(faces)
    assert found.mesh.vertices_world.dtype == round_about.points_world.dtype
    outward = face_normals(found.mesh.vertices_world, found.mesh.faces)
    assert ((outward * found.mesh.vertices_world[found.mesh.faces].mean(dim=1)).sum(1) > 0).all()
    expected = built(round_about, mesh.replace(vertices_world=vertices.float()))
    assert found.reference == expected.reference
    assert_close(found.points.points_world, expected.points.points_world)
    assert_close(found.points.covariance_world, expected.points.covariance_world)
    bare = without_points(round_about)
    assert len(facets_of(mesh, bare, round_about.views.names[3]).points.facet) == 0
    assert facets_of(mesh, bare, round_about.views.names[3]).reference == 3


def test_facets_of_a_misplaced_mesh_are_rejected(round_about):
    vertices, faces = icosphere(2)
    mesh = Mesh(vertices_world=1000 * vertices, faces=faces)
    with pytest.raises(InputError, match="not where the photographs show the object"):
        facets_of(mesh, round_about)
