import json
import math
import re
import socket
from contextlib import nullcontext
from types import SimpleNamespace
from urllib.request import urlopen

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from pimper_bench.scenes.procedural_meshes import icosphere
from pimper_torch.export.result import Result
from pimper_torch.geometry.pinholes import look_at
from pimper_torch.geometry.rigid import invert_rigid, transform
from pimper_torch.radiometry import linear_from_srgb
from pimper_torch.records import Mesh
from pimper_torch.runtime.errors import ConfigError, InputError, PimperWarning
from pimper_torch.viewer import layers
from pimper_torch.viewer import server as server_module
from pimper_torch.viewer.server import open_server, require_viser
from pimper_torch.viewer.show import add_found, show
from pimper_torch.viewer.viewer import NO_PHOTOGRAPH, Viewer, frame_of_cameras, frame_of_mesh
from pimper_torch.viz.report.vertex_layers import surface_layers
from tests.viewer.test_frame import cameras_on_a_ring

pytest.importorskip("viser")

COARSE, RESULT = "/surfaces/0: coarse surface", "/surfaces/1: result"


def node(viewer, name):
    return viewer.server.scene.get_handle_by_name(name)


@pytest.fixture
def page(viewer, reconstruction):
    """The page of a complete result."""
    add_found(viewer, reconstruction)
    return viewer


def test_the_page_is_served_only_to_the_local_machine(viewer):
    assert viewer.address.startswith("http://127.0.0.1:")
    with urlopen(viewer.address, timeout=10) as answer:
        assert answer.status == 200
        assert b"<html" in answer.read()[:2000].lower()
    assert viewer.address in viewer._repr_html_()


def test_the_scene_has_cameras_photographs_points_and_surface(page, reconstruction):
    assert len(page.server.get_scene_serializer().serialize()) > 10_000
    assert len(node(page, "/points").points) == len(reconstruction.scene.points_world)
    assert node(page, RESULT).glb_data[:4] == b"glTF"
    assert all(node(page, f"/cameras/{view:05d}").image is not None for view in range(3))
    frustum = node(page, "/cameras/00001")
    assert frustum.aspect == pytest.approx(60 / 40)
    assert frustum.fov == pytest.approx(2 * math.atan(20 / 90))


@pytest.fixture
def client(page, monkeypatch):
    """An open page, twice as wide as high."""
    camera = SimpleNamespace(up_direction=None, aspect=2.0, wxyz=np.array([1.0, 0, 0, 0]))
    lamp = SimpleNamespace(position=None)
    scene = SimpleNamespace(get_handle_by_name={"/light": lamp}.get)
    client = SimpleNamespace(camera=camera, scene=scene, atomic=nullcontext, client_id=0)
    monkeypatch.setattr(page.server, "get_clients", lambda: {0: client})
    return client


@pytest.fixture
def camera(client):
    return client.camera


def test_frusta_and_selected_views_have_the_poses_of_cameras(page, camera, reconstruction):
    from viser.transforms import SO3

    frame = page._viewer_from_world
    world_from_cam = invert_rigid(reconstruction.cameras.cam_from_world.double())
    placed = transform(frame, world_from_cam[:, :3, 3])
    ahead = transform(frame, (world_from_cam[:, :3, 3] + world_from_cam[:, :3, 2]))
    for view, name in enumerate(reconstruction.scene.views.names):
        frustum = node(page, f"/cameras/{view:05d}")
        # Float64 at distance 3 from the centre; coordinates may be zero.
        np.testing.assert_allclose(frustum.position, placed[view], atol=1e-12)
        forward = torch.nn.functional.normalize(ahead[view] - placed[view], dim=0)
        np.testing.assert_allclose(SO3(frustum.wxyz).as_matrix()[:, 2], forward, atol=1e-6)
        page.choose(name)
        np.testing.assert_allclose(camera.position, placed[view], atol=1e-6)
        gaze = torch.as_tensor(camera.look_at).double() - placed[view]
        assert_close(gaze / gaze.norm(), forward, rtol=0, atol=1e-6)
        assert camera.up_direction[2] > 0
        right = SO3(frustum.wxyz).as_matrix()[:, 0]
        assert abs(float(np.dot(camera.up_direction, right))) < 1e-6  # the image's right


def test_the_last_surface_is_shown_and_earlier_ones_are_kept(viewer, reconstruction):
    add_found(viewer, reconstruction.scene)
    assert node(viewer, "/points").visible
    viewer.add_pass("coarse surface", reconstruction.coarse.mesh)
    assert not node(viewer, "/points").visible  # the surface replaces them
    viewer.add_pass("result", reconstruction.mesh)
    assert [node(viewer, name).visible for name in (COARSE, RESULT)] == [False, True]
    assert viewer._about.content == f"**result**, {len(reconstruction.mesh.faces):,} faces."


def test_a_selected_photograph_hides_the_frusta_and_none_shows_the_complete_surface(
    page, client, camera, reconstruction
):
    page.choose(reconstruction.scene.views.names[0])
    assert not any(frustum.visible for frustum in page._frusta.values())
    page.choose(NO_PHOTOGRAPH)
    assert any(frustum.visible for frustum in page._frusta.values())
    vertices = transform(page._viewer_from_world, reconstruction.mesh.vertices_world.double())
    np.testing.assert_array_equal(page.server.initial_camera.position, camera.position)
    eye, middle = torch.as_tensor(camera.position)[None], torch.as_tensor(camera.look_at)
    pose = look_at(eye, middle.double(), torch.as_tensor(camera.up_direction).double())[0]
    for aspect in (2.0, 0.5):  # also after the window's resize
        camera.aspect = aspect
        page._follow(client)
        x, y, z = transform(pose, vertices).unbind(dim=1)
        half = math.tan(camera.fov / 2)
        across, down = (x / z).abs().max() / (half * aspect), (y / z).abs().max() / half
        assert 0.94 < max(across, down) < 0.96  # the margin


@pytest.fixture
def ball():
    """A sphere with all attributes of a result."""
    vertices, faces = icosphere(2)
    vertices = vertices.float()
    known = (vertices[:, 2] + 1) / 2
    return Mesh(
        vertices_world=vertices,
        faces=faces,
        normals_world=-vertices,
        albedo=0.5 + 0.4 * vertices,
        confidence=known,
        expected_error=known.square(),  # different from its confidence
    )


def test_layers_are_those_of_the_newest_surface(viewer, ball):
    viewer.add_pass("ball", ball)
    names = ("lit", "shape", "albedo", "normals", "expected error", "support")
    assert viewer._layer.options == names
    drawn, ends = set(), []
    for name in names:
        viewer._layer.value = name
        drawn.add(node(viewer, "/surfaces/0: ball").glb_data)
        if viewer._bar.visible:
            ends.append(re.findall("<span>(.*?)</span>", viewer._bar.content))
            assert "rgb(68 1 84), " in viewer._bar.content  # viridis' first colour
    assert len(drawn) == len(names)
    layers_of_numbers = surface_layers(ball)
    assert layers_of_numbers[0].high_text.endswith("% of the object's size or more")
    viewer.unit, viewer._layer.value = "mm", "expected error"
    assert "<span>1 mm or more</span>" in viewer._bar.content
    assert ends == [[layer.low_text, layer.high_text] for layer in layers_of_numbers]
    assert layers_of_numbers[0].about in viewer._about.content
    viewer.add_pass("bare", Mesh(vertices_world=ball.vertices_world, faces=ball.faces))
    assert viewer._layer.options == ("lit", "shape", "normals")
    assert viewer._layer.value == "lit"
    assert not viewer._bar.visible


def test_layers_have_the_expected_colours(ball, monkeypatch):
    """The ball's world is the viewer's frame; its normals point inward."""
    monkeypatch.setattr(layers, "gltf_of", lambda *given: given)
    shown = {name: layers.painted(ball, name, torch.eye(4).double())[0] for name in layers.LAYERS}
    assert ["extensions" in material for _, _, material in shown.values()] == [0, 0, 1, 1]
    outward = ball.vertices_world.numpy()
    for name, sign in [("lit", -1), ("shape", 1)]:  # the shape is shaded by geometric normals
        assert ((shown[name][0]["NORMAL"] * sign * outward).sum(axis=1) > 0.99).all()
    colors = {name: attributes["COLOR_0"] for name, (attributes, _, _) in shown.items()}
    np.testing.assert_array_equal(colors["lit"], colors["albedo"])
    assert (colors["shape"] == 0.5).all()
    # From the reference camera at x, y is right (red), and z is up (green).
    encoded = torch.tensor(0.5 - 0.5 * outward[:, [1, 2, 0]])
    np.testing.assert_allclose(colors["normals"], linear_from_srgb(encoded), atol=1e-6)
    error = layers.painted(ball, "expected error", torch.eye(4).double())[0][0]["COLOR_0"]
    assert (np.diff(error.sum(axis=1)[outward[:, 2].argsort()]) > -1e-6).all()


def test_the_disc_sets_the_light_relative_to_the_viewpoint(page, client):
    """The viewpoint looks along z with y down, then rotates about y to look along x."""
    lamp = client.scene.get_handle_by_name("/light")
    for right, up, direction in [(0, 0, (0, 0, -1)), (0.6, 0, (0.6, 0, -0.8)), (0, 1, (0, -1, 0))]:
        page._light.value = f"{right} {up}"
        page._turn_lights()
        np.testing.assert_allclose(lamp.position, direction, atol=1e-9)
    page._light.value = "0.0 0.0"
    client.camera.wxyz = np.array([0.5**0.5, 0, 0.5**0.5, 0])
    page._turn_lights()
    np.testing.assert_allclose(lamp.position, (-1, 0, 0), atol=1e-9)


def test_frusta_between_the_eye_and_the_surface_are_hidden(viewer):
    """A surface of radius 1 viewed from x, slightly above, with a ring of cameras."""
    cameras = cameras_on_a_ring(12, 3.0, 1.0)
    names = [f"{number}.jpg" for number in range(12)]
    vertices, faces = icosphere(2)
    viewer.add_cameras(names, cameras, torch.zeros(1, 3), 0)
    viewer.add_pass("ball", Mesh(vertices_world=vertices.float() / 2, faces=faces))
    hidden = {name for name, frustum in viewer._frusta.items() if not frustum.visible}
    assert not hidden  # the viewpoint is nearer than the cameras
    viewer._see_whole(1.35 * vertices)  # now farther: the first camera is in front of it
    assert {name for name, one in viewer._frusta.items() if not one.visible} == {"0.jpg"}


def test_a_narrow_page_shows_the_complete_photograph(page, client, reconstruction):
    name = reconstruction.scene.views.names[0]
    _, fov, aspect = page._cameras[name]
    page.choose(name)
    assert client.camera.fov == pytest.approx(fov)
    client.camera.aspect = 0.5
    page.choose(name)
    across = 2 * math.atan(0.5 * math.tan(client.camera.fov / 2))
    assert across == pytest.approx(2 * math.atan(aspect * math.tan(fov / 2)))


def test_the_photograph_fades_in_at_its_pixels(page, client, reconstruction):
    name = reconstruction.scene.views.names[1]
    page._fade.value = 0.25
    assert node(page, "/photograph") is None
    page.choose(name)
    glb = node(page, "/photograph").glb_data
    tree = json.loads(glb[20 : 20 + int.from_bytes(glb[12:16], "little")])
    (material,) = tree["materials"]
    assert material["alphaMode"] == "BLEND"
    assert material["pbrMetallicRoughness"]["baseColorFactor"][3] == 0.25
    corners, cameras = page._panes[name][1], reconstruction.cameras
    back = torch.linalg.inv(page._viewer_from_world)
    seen = (
        transform(cameras.cam_from_world[1].double(), transform(back, torch.tensor(corners)))
        @ cameras.intrinsics[1].double().mT
    )
    width, height = cameras.sizes_px[1].tolist()
    wanted = torch.tensor([[0, 0], [width, 0], [width, height], [0, height]]).double()
    assert_close(seen[:, :2] / seen[:, 2:], wanted, atol=1e-6, rtol=0)
    page._fade.value = 0.0
    assert node(page, "/photograph") is None
    page._fade.value = 1.0
    page.choose(NO_PHOTOGRAPH)
    assert node(page, "/photograph") is None
    assert not page._fade.visible


def test_a_cloud_is_not_shown_as_a_surface(viewer, reconstruction):
    cloud = Mesh(
        vertices_world=reconstruction.mesh.vertices_world, faces=torch.zeros(0, 3, dtype=torch.long)
    )
    with pytest.raises(InputError, match="no faces"):
        viewer.add_pass("surface", cloud)


def test_show_accepts_results_of_chains_and_folders(reconstruction):
    scene = reconstruction.scene
    read = Result(
        mesh=reconstruction.mesh,
        scene=scene,
        names=scene.views.names,
        cameras=scene.cameras,
        offset_world=scene.offset_world,
        silhouettes=reconstruction.silhouettes,
        lights_world=None,
        reference=scene.views.names[1],
        summary={},
    )
    towards = frame_of_cameras(scene.cameras, 1)
    shown = [
        (reconstruction, RESULT, towards),
        (read, "/surfaces/0: result", towards),
        (reconstruction.mesh, "/surfaces/0: surface", frame_of_mesh(reconstruction.mesh)),
    ]
    for result, surface, frame in shown:
        with show(result, port=0) as viewer:
            assert node(viewer, surface).visible
            assert_close(viewer._viewer_from_world, frame)


def test_show_closes_its_viewer_on_failure(tmp_path, monkeypatch):
    closed = []
    monkeypatch.setattr(
        Viewer, "stop", lambda self: closed.append(self.server) or self.server.stop()
    )
    with pytest.raises(InputError):
        show(tmp_path / "nothing", port=0)
    with pytest.raises(OSError, match="refused"):
        urlopen(f"http://127.0.0.1:{closed[0].get_port()}", timeout=5)


def test_a_port_in_use_is_refused():
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with Viewer(port=port) as viewer:
            assert viewer.server.get_port() != port


def test_the_viewer_does_not_write_to_standard_output(capsys):
    with Viewer(port=0):
        pass
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("place", "needed"),
    [
        ({"port": -1}, "0 to 65535"),
        ({"port": 65_536}, "0 to 65535"),
        ({"host": "192.0.2.1"}, "an address of this machine"),
        ({"host": "no such host"}, "an address of this machine"),
        ({"host": ""}, "an address of this machine"),
    ],
)
def test_an_invalid_address_is_refused(place, needed):
    with pytest.raises(ConfigError, match=needed):
        open_server(**place)


def test_a_page_open_to_other_machines_gives_a_warning():
    with (
        pytest.warns(PimperWarning, match="everyone who can connect to this machine"),
        Viewer("0.0.0.0", 0),
    ):
        pass


def test_without_viser_the_error_names_the_extra_to_install(monkeypatch):
    monkeypatch.setattr(server_module, "find_spec", lambda _: None)
    with pytest.raises(ConfigError, match=r"pip install 'pimper_torch\[view\]'"):
        require_viser()
