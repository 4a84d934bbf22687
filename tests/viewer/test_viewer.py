import math
import socket
from urllib.request import urlopen

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from pimper_torch.doors.exchange.result import Result
from pimper_torch.ground.geometry.rigid import invert_rigid, transform
from pimper_torch.records import Mesh
from pimper_torch.result.viewer import server as server_module
from pimper_torch.result.viewer.server import open_server, require_viser
from pimper_torch.result.viewer.show import add_found, show
from pimper_torch.result.viewer.viewer import NO_PHOTOGRAPH, Viewer
from pimper_torch.runtime.errors import ConfigError, InputError, PimperWarning

pytest.importorskip("viser")

COARSE, RESULT = "/surfaces/0: coarse surface", "/surfaces/1: result"


def node(viewer, name):
    return viewer.server.scene.get_handle_by_name(name)


@pytest.fixture
def page(viewer, reconstruction):
    """The page of a whole result."""
    add_found(viewer, reconstruction)
    return viewer


def test_the_page_comes_by_http_from_this_machine_alone(viewer):
    assert viewer.address.startswith("http://127.0.0.1:")
    with urlopen(viewer.address, timeout=10) as answer:
        assert answer.status == 200
        assert b"<html" in answer.read()[:2000].lower()
    assert viewer.address in viewer._repr_html_()


def test_scene_holds_cameras_photographs_points_and_surface(page, reconstruction):
    assert len(page.server.get_scene_serializer().serialize()) > 10_000
    assert len(node(page, "/points").points) == len(reconstruction.scene.points_world)
    assert node(page, RESULT).glb_data[:4] == b"glTF"
    assert all(node(page, f"/cameras/{view:05d}").image is not None for view in range(3))
    frustum = node(page, "/cameras/00001")
    assert frustum.aspect == pytest.approx(60 / 40)
    assert frustum.fov == pytest.approx(2 * math.atan(20 / 90))


def test_frusta_and_pages_stand_where_the_cameras_do(page, reconstruction):
    from viser.transforms import SO3

    frame = page._viewer_from_world
    world_from_cam = invert_rigid(reconstruction.cameras.cam_from_world.double())
    placed = transform(frame, world_from_cam[:, :3, 3])
    ahead = transform(frame, (world_from_cam[:, :3, 3] + world_from_cam[:, :3, 2]))
    for view, name in enumerate(reconstruction.scene.views.names):
        frustum = node(page, f"/cameras/{view:05d}")
        # Float64 at three units from the middle; coordinates may be zero.
        np.testing.assert_allclose(frustum.position, placed[view], atol=1e-12)
        forward = torch.nn.functional.normalize(ahead[view] - placed[view], dim=0)
        np.testing.assert_allclose(SO3(frustum.wxyz).as_matrix()[:, 2], forward, atol=1e-6)
        if name == page._chosen.value:
            camera = page.server.initial_camera
            np.testing.assert_allclose(camera.position, placed[view], atol=1e-6)
            gaze = torch.as_tensor(camera.look_at).double() - placed[view]
            assert_close(gaze / gaze.norm(), forward, rtol=0, atol=1e-6)
            assert camera.up[2] > 0
            right = SO3(frustum.wxyz).as_matrix()[:, 0]
            assert abs(float(np.dot(camera.up, right))) < 1e-6  # right in its picture is right


def test_the_last_surface_is_shown_and_those_before_are_kept(viewer, reconstruction):
    add_found(viewer, reconstruction.scene)
    assert node(viewer, "/points").visible
    viewer.add_pass("coarse surface", reconstruction.coarse.mesh)
    assert not node(viewer, "/points").visible  # they lie on the surface
    viewer.add_pass("result", reconstruction.mesh)
    assert [node(viewer, name).visible for name in (COARSE, RESULT)] == [False, True]
    assert viewer._about.content == f"**result**, {len(reconstruction.mesh.faces):,} faces."


def test_choosing_a_photograph_hides_its_frustum(page, reconstruction):
    names = reconstruction.scene.views.names
    page.choose(names[0])
    assert [node(page, f"/cameras/{view:05d}").visible for view in range(3)] == [0, 1, 1]
    page.choose(NO_PHOTOGRAPH)
    assert all(node(page, f"/cameras/{view:05d}").visible for view in range(3))


def test_a_cloud_is_no_surface(viewer, reconstruction):
    cloud = Mesh(
        vertices_world=reconstruction.mesh.vertices_world, faces=torch.zeros(0, 3, dtype=torch.long)
    )
    with pytest.raises(InputError, match="no faces"):
        viewer.add_pass("surface", cloud)


def test_show_takes_what_chains_and_folders_return(reconstruction):
    scene = reconstruction.scene
    read = Result(
        mesh=reconstruction.mesh,
        scene=scene,
        cameras=scene.cameras,
        silhouettes=reconstruction.silhouettes,
        lights_world=None,
        reference=scene.views.names[1],
        summary={},
    )
    shown = [
        (reconstruction, RESULT, scene.views.names[reconstruction.coarse.reference]),
        (read, "/surfaces/0: result", scene.views.names[1]),
        (reconstruction.mesh, "/surfaces/0: surface", NO_PHOTOGRAPH),
    ]
    for result, surface, photograph in shown:
        with show(result, port=0) as viewer:
            assert node(viewer, surface).visible
            assert viewer._chosen.value == photograph


def test_show_closes_what_it_cannot_fill(tmp_path, monkeypatch):
    closed = []
    monkeypatch.setattr(
        Viewer, "stop", lambda self: closed.append(self.server) or self.server.stop()
    )
    with pytest.raises(InputError):
        show(tmp_path / "nothing", port=0)
    with pytest.raises(OSError, match="refused"):
        urlopen(f"http://127.0.0.1:{closed[0].get_port()}", timeout=5)


def test_a_taken_port_is_left_alone():
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with Viewer(port=port) as viewer:
            assert viewer.server.get_port() != port


def test_nothing_is_written_on_standard_output(capsys):
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
def test_an_impossible_place_is_refused(place, needed):
    with pytest.raises(ConfigError, match=needed):
        open_server(**place)


def test_a_page_that_others_reach_is_warned_of():
    with pytest.warns(PimperWarning, match="whoever reaches this machine"), Viewer("0.0.0.0", 0):
        pass


def test_without_viser_the_error_names_what_to_install(monkeypatch):
    monkeypatch.setattr(server_module, "find_spec", lambda _: None)
    with pytest.raises(ConfigError, match=r"pip install 'pimper_torch\[view\]'"):
        require_viser()
