import pytest
import torch
import trimesh
from scenes import ball, without_points
from torch.testing import assert_close

import pimper_torch as pt
from pimper_bench.scenes.procedural_meshes import icosphere
from pimper_bench.scenes.scene_cameras import arc_cameras
from pimper_torch.chains.prepare import in_scene
from pimper_torch.geometry.local_frame import to_local
from pimper_torch.geometry.surfaces import face_normals
from pimper_torch.geometry.topology import boundary_loops, face_components
from pimper_torch.geometry.visibility import RayCaster
from pimper_torch.stages.coarse.given_mesh import oriented_outward, prepared
from tests.coarse.ball import all_round, silhouettes_of


def test_every_component_faces_outward_for_any_winding():
    ball, faces = icosphere(2)
    vertices = torch.cat([0.4 * ball - 0.6, 0.4 * ball + 0.6])
    both = torch.cat([faces, faces.flip(1) + len(ball)])
    generator = torch.Generator().manual_seed(2)
    mixed = torch.rand(len(both), 1, generator=generator) < 0.4
    mesh = pt.Mesh(vertices_world=vertices, faces=torch.where(mixed, both.flip(1), both))
    found, wound = oriented_outward(mesh, all_round())
    assert int(face_components(wound).max()) == 1
    centre = torch.where((found[wound].mean(dim=1) > 0).all(dim=1, keepdim=True), 0.6, -0.6)
    outward = (face_normals(found, wound) * (found[wound].mean(dim=1) - centre)).sum(dim=1)
    assert bool((outward > 0).all())
    assert_close(found, vertices)


def test_an_open_sheet_faces_the_cameras_without_slivers_and_unused_vertices():
    vertices = torch.tensor(
        [[9.0, 9, 9], [-1, -1, 0], [1, -1, 0], [0, 1, 0], [0.5, 0, 0]], dtype=torch.float64
    )
    faces = torch.tensor([[1, 3, 2], [2, 4, 3]])  # the second on an edge of the first
    cameras = arc_cameras(3, width=60, height=40, focal_px=60.0, distance=4.0, sway_deg=0.0)
    assert bool((cameras.centers_world[:, 2] > 0).all())
    found, wound = oriented_outward(pt.Mesh(vertices_world=vertices, faces=faces), cameras)
    assert_close(found, vertices[1:4])
    assert sorted(wound[0].tolist()) == [0, 1, 2]
    assert float(face_normals(found, wound)[0, 2]) > 0


def test_a_mesh_that_no_camera_sees_is_rejected():
    vertices, faces = icosphere(0)
    with pytest.raises(pt.InputError, match="no photograph shows"):
        oriented_outward(pt.Mesh(vertices_world=vertices + 1e4, faces=faces), all_round())


PLACE = torch.tensor([0.6, 1.1, 1.9], dtype=torch.float64)  # no two axes may be interchanged
AWAY = (448231.0, 5411923.0, 312.0)


@pytest.fixture(scope="module")
def scene(dome_cloud):
    """A ball off the origin, with exact points of the side that five views see."""
    poses = dome_cloud.cameras.cam_from_world.double()
    moved = poses.clone()
    moved[:, :3, 3] -= poses[:, :3, :3] @ PLACE
    return dome_cloud.replace(
        cameras=dome_cloud.cameras.replace(cam_from_world=moved.float()),
        points_world=dome_cloud.points_world + PLACE.float(),
    )


@pytest.fixture(scope="module")
def unknown(scene):
    return pt.Silhouettes.everything(scene.views)


@pytest.fixture(scope="module")
def masks(scene):
    return silhouettes_of(
        scene.cameras.to(torch.float64).replace(
            cam_from_world=to_local(scene.cameras.cam_from_world.double(), tuple(PLACE.tolist()))
        )
    )


@pytest.fixture(scope="module")
def true_mesh():
    return ball(level=4, center=PLACE.tolist())


def exchanged(mesh, *axes):
    return mesh.replace(vertices_world=mesh.vertices_world[:, list(axes)])


def test_the_true_mesh_is_unchanged_and_fits(scene, unknown, masks, true_mesh):
    for silhouettes in (unknown, masks):
        found, figures = prepared(true_mesh, scene, silhouettes)
        assert torch.equal(found.faces, true_mesh.faces)
        assert torch.equal(found.vertices_world, true_mesh.vertices_world.float())
        assert figures["faces"] == len(true_mesh.faces)
        assert figures["on_mesh"] > 0.99
        assert figures["distance_percent"] < 0.1
        assert figures["observations"] > 1000
    assert figures["overlap"] > 0.95  # a polyhedron in rays 2.5 pixels apart


@pytest.mark.parametrize("suffix", [".stl", ".obj", ".ply", ".glb"])
def test_a_triangle_soup_gives_the_surface_of_the_welded_mesh(
    scene, unknown, true_mesh, suffix, tmp_path
):
    corners = true_mesh.vertices_world[true_mesh.faces].reshape(-1, 3)
    apart = torch.arange(len(corners)).reshape(-1, 3)
    trimesh.Trimesh(corners.numpy(), apart.numpy(), process=False).export(tmp_path / f"a{suffix}")
    found, _ = prepared(pt.read_mesh(tmp_path / f"a{suffix}"), scene, unknown)
    assert len(found.vertices_world) == len(true_mesh.vertices_world)
    assert len(found.faces) == len(true_mesh.faces)
    assert len(boundary_loops(found.faces)[0]) == 0
    surface = [
        mesh.vertices_world.float()[mesh.faces].mean(dim=1).double() for mesh in (found, true_mesh)
    ]
    assert_close(*surface, rtol=0, atol=1e-6)


def test_degenerate_faces_are_dropped_and_counted(scene, unknown, true_mesh):
    faces = true_mesh.faces
    middle = true_mesh.vertices_world[faces[0, :2]].mean(dim=0, keepdim=True)
    vertices = torch.cat([true_mesh.vertices_world, middle])
    sliver = torch.tensor([[int(faces[0, 0]), len(vertices) - 1, int(faces[0, 1])]])
    added = torch.cat([faces, faces[:6, [0, 0, 1]], sliver, faces[:4].flip(1), faces[9:10]])
    with pytest.warns(pt.PimperWarning, match="7 without area, 5 duplicated"):
        found, _ = prepared(pt.Mesh(vertices_world=vertices, faces=added), scene, unknown)
    assert len(found.vertices_world) == len(true_mesh.vertices_world)
    assert sorted(map(sorted, found.faces.tolist())) == sorted(map(sorted, faces.tolist()))


def test_a_mesh_without_area_is_rejected(scene, unknown, true_mesh):
    flat = true_mesh.replace(faces=true_mesh.faces[:9, [0, 1, 1]])
    with pytest.raises(pt.InputError, match="none of the given mesh's 9 faces has an area"):
        prepared(flat, scene, unknown)
    line = pt.Mesh(vertices_world=PLACE + torch.arange(4)[:, None], faces=torch.tensor([[0, 1, 2]]))
    with pytest.raises(pt.InputError, match="none of the given mesh's 1 faces has an area"):
        prepared(line, scene, unknown)
    with pytest.raises(pt.InputError, match="no faces"):
        prepared(true_mesh.replace(faces=true_mesh.faces[:0]), scene, unknown)


@pytest.mark.parametrize("with_masks", [False, True])
@pytest.mark.parametrize(
    "change",
    [
        lambda mesh: exchanged(mesh, 0, 2, 1),
        lambda mesh: exchanged(mesh, 2, 0, 1),
        lambda mesh: mesh.replace(vertices_world=mesh.vertices_world * torch.tensor([1, 1, -1])),
        lambda mesh: mesh.replace(vertices_world=1000 * mesh.vertices_world),
        lambda mesh: mesh.replace(vertices_world=mesh.vertices_world / 25.4),
    ],
)
def test_a_mesh_in_a_different_frame_is_rejected_or_warned_of(
    scene, unknown, masks, true_mesh, change, with_masks
):
    with pytest.raises((pt.InputError, pt.PimperWarning), match=r"(where|from) the photographs"):
        prepared(change(true_mesh), scene, masks if with_masks else unknown)


def test_without_points_masks_warn_of_a_different_frame(scene, masks, true_mesh):
    bare = without_points(scene)
    _, figures = prepared(true_mesh, bare, masks)
    assert set(figures) == {"faces", "overlap", "observations"}
    with pytest.warns(pt.PimperWarning, match=r"deviates .*overlap with the masks by 38%"):
        prepared(exchanged(true_mesh, 0, 2, 1), bare, masks)


def test_a_wrong_mesh_is_rejected_and_a_rough_one_warned_of(scene, unknown, true_mesh):
    def scaled(factor):
        about = true_mesh.vertices_world - PLACE
        return true_mesh.replace(vertices_world=PLACE + factor * about)

    with pytest.raises(pt.InputError, match="not where the photographs show the object: 0% of"):
        prepared(scaled(0.5), scene, unknown)
    with pytest.warns(pt.PimperWarning, match=r"median distance is 2\.\d% of the diagonal \(0.08"):
        _, figures = prepared(scaled(0.92), scene, unknown)
    assert abs(figures["distance_percent"] - 100 * 0.08 / (0.92 * 12**0.5)) < 0.05
    prepared(scaled(0.97), scene, unknown)  # no warning
    box = trimesh.creation.box(bounds=[(PLACE - 1).tolist(), (PLACE + 1).tolist()])
    rough = pt.Mesh(vertices_world=torch.tensor(box.vertices), faces=torch.tensor(box.faces).long())
    with pytest.warns(pt.PimperWarning, match="mesh deviates from the photographs"):
        prepared(rough, scene, unknown)


def test_background_points_do_not_count_against_a_mesh(scene, unknown, true_mesh):
    """They are not on the mesh: half the cloud is a wall behind the ball."""
    generator = torch.Generator().manual_seed(3)
    wall = 4 * torch.rand(3000, 3, generator=generator) - 2 + PLACE.float()
    wall[:, 2] = float(PLACE[2]) - 1.5
    caster = RayCaster(true_mesh.vertices_world, true_mesh.faces)
    hidden = torch.stack(
        [caster.occluded(wall, center, 0.01) for center in scene.cameras.centers_world], dim=1
    )
    point, view = (~hidden).nonzero(as_tuple=True)
    count = len(scene.points_world)
    both = scene.replace(
        points_world=torch.cat([scene.points_world, wall]),
        reprojection_errors_px=torch.cat([scene.reprojection_errors_px, torch.zeros(len(wall))]),
        observation_point=torch.cat([scene.observation_point, point + count]),
        observation_view=torch.cat([scene.observation_view, view]),
        observation_pixels=torch.cat([scene.observation_pixels, torch.zeros(len(point), 2)]),
    )
    _, figures = prepared(true_mesh, both, unknown)
    assert figures["on_mesh"] > 0.95
    with pytest.raises(pt.InputError, match="not where"):
        prepared(exchanged(true_mesh, 0, 2, 1), both, unknown)


def test_a_mesh_is_transformed_with_cameras_far_from_the_origin(scene, unknown, true_mesh):
    """Given photographs, it is in the frame of their model; given a scene, in that of the scene."""
    far = scene.replace(offset_world=AWAY)
    brought = true_mesh.replace(
        vertices_world=true_mesh.vertices_world + torch.tensor(AWAY, dtype=torch.float64)
    )
    plain = in_scene(true_mesh, scene, scene, unknown)
    assert torch.equal(plain.vertices_world, true_mesh.vertices_world.float())
    for mesh, source in ((brought, scene.views), (true_mesh, far)):
        found = in_scene(mesh, source, far, unknown)
        assert_close(found.vertices_world, plain.vertices_world, rtol=0, atol=1e-6)
    assert in_scene(None, scene.views, far, unknown) is None
    with pytest.warns(pt.PimperWarning, match=r"deviates .*rays to 0 of \d+ "):
        in_scene(exchanged(brought, 0, 2, 1), scene.views, far, unknown)
