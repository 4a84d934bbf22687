import json
import shutil

import pytest
from scenes import write_ball
from torch.testing import assert_close

from pimper_bench.datasets.rendered import read_rendered
from pimper_bench.scenes.ray_tracing import TracedObjects, render_frame
from pimper_bench.scenes.rendered_folder import render_scene
from pimper_bench.scenes.scene_settings import SceneConfig
from pimper_bench.scenes.whole_scene import build_scene
from pimper_torch.runtime.errors import InputError

CONFIG = SceneConfig(num_views=3, width=50, height=36, supersample=1, specular=0.05)


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    return write_ball(tmp_path_factory.mktemp("meshes") / "ball.ply")


@pytest.fixture(scope="module")
def rendering(ball, tmp_path_factory):
    return render_scene(ball, tmp_path_factory.mktemp("out") / "scene", CONFIG, processes=1)


@pytest.fixture
def copy(rendering, tmp_path):
    return shutil.copytree(rendering, tmp_path / "copy")


def test_a_rendering_survives_a_round_trip(rendering, ball):
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


def test_selected_views_equal_those_of_the_complete_set(rendering):
    whole, some = read_rendered(rendering), read_rendered(rendering, views=[2, 0])
    assert some.views.names == (whole.views.names[2], whole.views.names[0])
    assert_close(some.views.images, whole.views.images[[2, 0]])
    assert_close(some.cameras.cam_from_world, whole.cameras.cam_from_world[[2, 0]])
    assert_close(some.truth.depth, whole.truth.depth[[2, 0]])
    assert_close(some.truth.lights_world, whole.truth.lights_world[[2, 0]])
    assert some.position.tolist() == [2, 0]


def test_linear_deep_photographs_are_not_decoded_as_srgb(ball, tmp_path):
    config = SceneConfig(
        num_views=2, width=40, height=30, supersample=1, bits=16, encoding="linear"
    )
    render_scene(ball, tmp_path / "deep", config, processes=1)
    scene = build_scene(ball, config)
    frame = render_frame(
        TracedObjects(scene.objects), scene.cameras, scene.lights, 0, scene.noise(0), config.sensor
    )
    found = read_rendered(tmp_path / "deep", views=[0]).views.images[0]
    assert_close(found, frame.image, atol=0.51 / 65535, rtol=0)


def test_removed_settings_are_ignored(copy):
    path = copy / "truth" / "scene.json"
    account = json.loads(path.read_text())
    account["settings"]["bounces"] = 0
    path.write_text(json.dumps(account))
    assert read_rendered(copy, maps=False).views.num_views == 3


@pytest.mark.parametrize("views", [[3], [-1], [0, 0], []])
def test_missing_views_are_refused(rendering, views):
    with pytest.raises(InputError, match="different views between 0 and 2"):
        read_rendered(rendering, views=views)


def _without(name):
    return lambda folder: (folder / name).unlink()


def _damaged(name):
    return lambda folder: (folder / name).write_bytes(b"nonsense")


def _saying(name, **changes):
    def spoil(folder):
        path = folder / "truth" / name
        path.write_text(json.dumps(json.loads(path.read_text()) | changes))

    return spoil


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (_without("photos/view_001.png"), r"photos/view_001\.png: does not exist"),
        (_without("masks/view_001.png"), r"masks/view_001\.png: does not exist"),
        (_without("truth/maps/view_001.npz"), r"a file view_001\.npz"),
        (_without("truth/lights.json"), r"truth: .*a file lights\.json"),
        (_without("truth/scene.json"), r"truth: .*a file scene\.json"),
        (_without("truth/mesh.ply"), r"mesh\.ply"),
        (_damaged("truth/maps/view_001.npz"), r"view_001\.npz"),
        (_damaged("truth/lights.json"), r"lights\.json"),
        (_saying("lights.json", harmonics_world=[[1, 0, 0, 0]] * 2), "each of 3 views"),
        (_saying("scene.json", format="holiday pictures"), "holiday pictures"),
        (_saying("scene.json", format_version=2), "version 2"),
        (_saying("scene.json", names=["../a.png", "b.png", "c.png"]), "file names"),
        (_saying("scene.json", names=["a.png", "b.png"]), "num_views = 3"),
        (_saying("scene.json", settings={"width": "wide"}), "width"),
        (
            _saying("scene.json", settings={"num_views": 3, "width": 60, "height": 36}),
            "60 x 36 pixels",
        ),
    ],
)
def test_a_folder_with_other_content_is_refused(copy, spoil, words):
    spoil(copy)
    with pytest.raises(InputError, match=words):
        read_rendered(copy)


def test_unrequested_maps_take_no_memory(rendering):
    lean = read_rendered(rendering, maps=False, photographs=False)
    assert lean.truth.depth is lean.truth.foreground is lean.views.masks is None
    assert lean.views.images.shape == (3, 3, 36, 50)
    assert lean.views.images.untyped_storage().nbytes() == 4
    assert lean.truth.mesh is not None
