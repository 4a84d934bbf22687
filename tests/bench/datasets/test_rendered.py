import json
import shutil

import pytest
import torch
from torch.testing import assert_close

from pimper_bench.datasets.rendered import read_rendered
from pimper_bench.scenes.procedural_meshes import icosphere
from pimper_bench.scenes.ray_tracing import TracedObjects, render_frame
from pimper_bench.scenes.rendered_folder import render_scene
from pimper_bench.scenes.scene_settings import SceneConfig
from pimper_bench.scenes.whole_scene import build_scene
from pimper_torch.doors.io.meshes import write_ply
from pimper_torch.records import Mesh
from pimper_torch.runtime.errors import InputError

CONFIG = SceneConfig(num_views=3, width=50, height=36, supersample=1, specular=0.05)


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    path = tmp_path_factory.mktemp("meshes") / "ball.ply"
    vertices, faces = icosphere(3)
    write_ply(Mesh(vertices_world=vertices, faces=faces), path)
    return path


@pytest.fixture(scope="module")
def rendering(ball, tmp_path_factory):
    return render_scene(ball, tmp_path_factory.mktemp("out") / "scene", CONFIG, processes=1)


@pytest.fixture
def copy(rendering, tmp_path):
    return shutil.copytree(rendering, tmp_path / "copy")


def test_what_is_read_is_what_was_rendered(rendering, ball):
    scene = build_scene(ball, CONFIG)
    capture = read_rendered(rendering)
    cameras, truth = capture.cameras, capture.truth
    assert capture.views.names == scene.names
    assert_close(cameras.cam_from_world, scene.cameras.cam_from_world, atol=1e-12, rtol=0)
    assert_close(cameras.intrinsics, scene.cameras.intrinsics)
    assert_close(cameras.sizes_px, scene.cameras.sizes_px)
    assert_close(truth.lights_world, scene.lights.harmonics_world())
    assert_close(truth.mesh.vertices_world, scene.object_mesh.vertices_world, atol=1e-6, rtol=0)
    assert_close(truth.mesh.faces, scene.object_mesh.faces)
    assert len(truth.surroundings.faces) == len(scene.surroundings_mesh.faces)
    stage = TracedObjects(scene.objects)
    for view in range(3):
        frame = render_frame(
            stage, scene.cameras, scene.lights, view, scene.noise(view), CONFIG.sensor
        )
        # Half a byte, where sRGB is steepest: 2.4 / 1.055 of it.
        assert_close(capture.views.images[view], frame.image, atol=0.5 / 255 * 2.4, rtol=0)
        assert_close(capture.views.masks[view], frame.foreground)
        assert_close(truth.depth[view], frame.depth)
        assert_close(truth.normals_world[view], frame.normals_world, atol=6e-4, rtol=0)
        assert_close(truth.albedo[view], frame.albedo, atol=3e-4, rtol=0)
        for name in ("foreground", "lit", "highlight"):
            assert_close(getattr(truth, name)[view], getattr(frame, name))
    assert truth.highlight.any()
    assert capture.position.tolist() == capture.light.tolist() == [0, 1, 2]


def test_some_views_are_those_of_the_whole_in_the_order_wanted(rendering):
    whole, some = read_rendered(rendering), read_rendered(rendering, views=[2, 0])
    assert some.views.names == (whole.views.names[2], whole.views.names[0])
    assert_close(some.views.images, whole.views.images[[2, 0]])
    assert_close(some.cameras.cam_from_world, whole.cameras.cam_from_world[[2, 0]])
    assert_close(some.truth.depth, whole.truth.depth[[2, 0]])
    assert_close(some.truth.lights_world, whole.truth.lights_world[[2, 0]])
    assert some.position.tolist() == [2, 0]


def test_what_is_not_wanted_takes_no_memory(rendering):
    lean = read_rendered(rendering, maps=False, photographs=False)
    assert lean.truth.depth is None
    assert lean.truth.foreground is None
    assert lean.views.masks is None
    assert lean.views.images.shape == (3, 3, 36, 50)
    assert lean.views.images.untyped_storage().nbytes() == 4
    assert lean.truth.mesh is not None


def test_linear_deep_photographs_are_not_decoded_as_srgb(ball, tmp_path):
    config = CONFIG.__class__(
        num_views=2, width=40, height=30, supersample=1, bits=16, encoding="linear"
    )
    render_scene(ball, tmp_path / "deep", config, processes=1)
    scene = build_scene(ball, config)
    frame = render_frame(
        TracedObjects(scene.objects), scene.cameras, scene.lights, 0, scene.noise(0), config.sensor
    )
    found = read_rendered(tmp_path / "deep", views=[0]).views.images[0]
    assert_close(found, frame.image, atol=0.51 / 65535, rtol=0)


@pytest.mark.parametrize("views", [[3], [-1], [0, 0], []])
def test_views_that_are_not_there_are_refused(rendering, views):
    with pytest.raises(InputError, match="different views between 0 and 2"):
        read_rendered(rendering, views=views)


def test_another_folder_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"truth: .*a file scene\.json"):
        read_rendered(tmp_path)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"format": "holiday pictures"}, "holiday pictures"),
        ({"format_version": 2}, "version 2"),
        ({"names": ["../a.png", "b.png", "c.png"]}, "file names"),
        ({"names": ["a.png", "b.png"]}, "num_views = 3"),
        ({"settings": {"width": "wide"}}, "width"),
        ({"settings": {"num_views": 3, "width": 60, "height": 36}}, "60 x 36 pixels"),
    ],
)
def test_an_account_that_cannot_be_is_refused(copy, change, words):
    path = copy / "truth" / "scene.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(InputError, match=words):
        read_rendered(copy)


def test_settings_that_have_gone_are_passed_over(copy):
    path = copy / "truth" / "scene.json"
    account = json.loads(path.read_text())
    account["settings"]["bounces"] = 0
    path.write_text(json.dumps(account))
    assert read_rendered(copy, maps=False).views.num_views == 3


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("photos/view_001.png", r"photos/view_001\.png: there is no such file"),
        ("masks/view_001.png", r"masks/view_001\.png: there is no such file"),
        ("truth/maps/view_001.npz", r"a file view_001\.npz"),
        ("truth/lights.json", r"truth: .*a file lights\.json"),
        ("truth/mesh.ply", r"mesh\.ply"),
    ],
)
def test_a_missing_file_is_named(copy, name, words):
    (copy / name).unlink()
    with pytest.raises(InputError, match=words):
        read_rendered(copy)


@pytest.mark.parametrize("name", ["truth/maps/view_001.npz", "truth/lights.json"])
def test_a_damaged_file_is_named(copy, name):
    (copy / name).write_bytes(b"nonsense")
    with pytest.raises(InputError, match=name.split("/")[-1].replace(".", r"\.")):
        read_rendered(copy)


def test_lights_of_fewer_views_are_refused(copy):
    path = copy / "truth" / "lights.json"
    report = json.loads(path.read_text())
    report["harmonics_world"] = report["harmonics_world"][:2]
    path.write_text(json.dumps(report))
    with pytest.raises(InputError, match="each of 3 views"):
        read_rendered(copy)


def test_lengths_of_normals_are_one_or_none(rendering):
    length = read_rendered(rendering).truth.normals_world.norm(dim=-1)
    seen = length > 0.5
    assert_close(length[seen], torch.ones(int(seen.sum())))
    assert (length[~seen] == 0).all()
