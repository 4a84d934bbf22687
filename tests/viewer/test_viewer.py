import math
import socket
from urllib.request import urlopen

import numpy as np
import pytest
import torch

from pimper_torch.doors.exchange.result import Result
from pimper_torch.ground.geometry.rigid import invert_rigid
from pimper_torch.records import Mesh
from pimper_torch.result.viewer import server as server_module
from pimper_torch.result.viewer.server import open_server, require_viser
from pimper_torch.result.viewer.show import add_found, show
from pimper_torch.result.viewer.viewer import NO_PHOTOGRAPH, opened
from pimper_torch.runtime.errors import ConfigError, InputError, PimperWarning

pytest.importorskip("viser")


def node(viewer, name):
    return viewer.server.scene.get_handle_by_name(name)


@pytest.fixture
def page(viewer, reconstruction):
    """The page of a whole result."""
    add_found(viewer, reconstruction.scene)
    viewer.add_pass("coarse surface", reconstruction.coarse.mesh)
    viewer.add_pass("result", reconstruction.mesh)
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
    assert node(page, "/surface").glb_data[:4] == b"glTF"
    for view in range(3):
        assert node(page, f"/cameras/{view:05d}") is not None
        assert node(page, f"/cameras/{view:05d}").image is not None
    frustum = node(page, "/cameras/00001")
    assert frustum.aspect == pytest.approx(60 / 40)
    assert frustum.fov == pytest.approx(2 * math.atan(20 / 90))


def test_a_frustum_stands_where_the_camera_does(page, reconstruction):
    from viser.transforms import SO3

    world_from_cam = invert_rigid(reconstruction.cameras.cam_from_world.double())
    placed = page._frame.points(world_from_cam[:, :3, 3]).numpy()
    forward = page._frame.directions(world_from_cam[:, :3, 2]).numpy()
    for view in range(3):
        frustum = node(page, f"/cameras/{view:05d}")
        # Float64 at three units from the middle; coordinates may be zero.
        np.testing.assert_allclose(frustum.position, placed[view], atol=1e-12)
        np.testing.assert_allclose(SO3(frustum.wxyz).as_matrix()[:, 2], forward[view], atol=1e-6)


def test_layers_change_the_colours_and_the_legend(page):
    seen, said = set(), set()
    for name in page._layer.options:
        page._layer.value = name
        seen.add(node(page, "/surface").glb_data)
        said.add(page._about.content)
    assert len(seen) == len(said) == 4


def test_the_slider_goes_back_to_earlier_surfaces(page, reconstruction):
    assert page._pass.visible
    assert page._pass.value == page._pass.max == 1
    assert f"**result**, {len(reconstruction.mesh.faces):,} faces" in page._about.content
    page._pass.value = 0
    assert "**coarse surface**" in page._about.content
    assert "grey clay" in page._about.content  # it has no albedo to be lit


def test_the_light_is_where_the_sliders_are(page):
    page._azimuth.value, page._elevation.value, page._ambient.value = 90.0, 0.0, 0.25
    direction = np.array(page._sun.position) / np.linalg.norm(page._sun.position)
    np.testing.assert_allclose(direction, [0, 1, 0], atol=1e-9)
    assert page._sky.intensity / page._sun.intensity == pytest.approx(1 / 3)
    page._elevation.value = 90.0
    np.testing.assert_allclose(np.array(page._sun.position)[:2], 0, atol=1e-9)


def test_choosing_a_photograph_hides_its_frustum(page, reconstruction):
    names = reconstruction.scene.views.names
    page.choose(names[0])
    assert [node(page, f"/cameras/{view:05d}").visible for view in range(3)] == [0, 1, 1]
    page.choose(NO_PHOTOGRAPH)
    assert all(node(page, f"/cameras/{view:05d}").visible for view in range(3))


@pytest.mark.parametrize("name", ["surface", "cameras", "points"])
def test_a_check_box_shows_and_hides(page, name):
    box = getattr(page, f"_{name}")
    for shown in (False, True, False):
        box.value = shown
        assert node(page, f"/{name}").visible == shown
    page._layer.value = "normals"
    assert node(page, f"/{name}").visible is False


def test_points_give_way_to_the_first_surface(viewer, reconstruction):
    add_found(viewer, reconstruction.scene)
    assert node(viewer, "/points").visible
    viewer.add_pass("coarse surface", reconstruction.coarse.mesh)
    assert not node(viewer, "/points").visible


def test_a_cloud_is_no_surface(viewer, reconstruction):
    cloud = Mesh(
        vertices_world=reconstruction.mesh.vertices_world, faces=torch.zeros(0, 3, dtype=torch.long)
    )
    with pytest.raises(InputError, match="no faces"):
        viewer.add_pass("surface", cloud)


def test_show_takes_what_chains_return(reconstruction):
    for result in (reconstruction, reconstruction.mesh):
        viewer = show(result, port=0)
        try:
            assert node(viewer, "/surface").visible
        finally:
            viewer.stop()


def test_a_result_that_was_read_begins_in_its_reference(reconstruction):
    scene = reconstruction.scene
    result = Result(
        mesh=reconstruction.mesh,
        scene=scene,
        cameras=scene.cameras,
        silhouettes=reconstruction.silhouettes,
        lights_world=None,
        reference=scene.views.names[1],
        summary={},
    )
    viewer = show(result, port=0)
    try:
        assert viewer._chosen.value == scene.views.names[1]
    finally:
        viewer.stop()


def test_show_closes_what_it_cannot_fill(tmp_path, monkeypatch):
    from pimper_torch.result.viewer import show as module

    opened_servers = []

    def kept(*place):
        opened_servers.append(open_server(*place))
        return opened_servers[0]

    monkeypatch.setattr(module, "open_server", kept)
    with pytest.raises(InputError):
        show(tmp_path / "nothing", port=0)
    with pytest.raises(OSError, match="refused"):
        urlopen(f"http://127.0.0.1:{opened_servers[0].get_port()}", timeout=5)


def test_a_taken_port_is_left_alone():
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with opened(port=port) as viewer:
            assert viewer.server.get_port() != port


def test_nothing_is_written_on_standard_output(capsys):
    with opened(port=0):
        pass
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("port", [-1, 65_536])
def test_an_impossible_port_is_refused(port):
    with pytest.raises(ConfigError, match="0 to 65535"):
        open_server(port=port)


@pytest.mark.parametrize("host", ["192.0.2.1", "no such host", ""])
def test_a_host_that_is_not_here_is_refused(host):
    with pytest.raises(ConfigError, match="an address of this machine"):
        open_server(host)


def test_a_page_that_others_reach_is_warned_of():
    with pytest.warns(PimperWarning, match="whoever reaches this machine"), opened("0.0.0.0", 0):
        pass


def test_without_viser_the_error_names_what_to_install(monkeypatch):
    monkeypatch.setattr(server_module, "find_spec", lambda _: None)
    with pytest.raises(ConfigError, match=r"pip install 'pimper_torch\[view\]'"):
        require_viser()
